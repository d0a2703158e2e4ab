"""Takes live messages into buffers, checked and on one clock."""

import logging
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError, SymbidError
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.messages.types import BOOL
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.signals.alignment import joint_columns

logger = logging.getLogger(__name__)

POSTURE_TIME = 50_000_000  # ns; every part of a robot publishes its joints within this time


class MessageIntake:
    """Takes the messages of a robot's topics into buffers, without the invalid ones.

    Parameters
    ----------
    selected : SelectedTopics
        The robot's sensors.
    model : RobotModel
        Its joints and frames.
    streams : LiveStreams
        Buffers of the messages.
    restart : callable
        Restarts the clock of all topics when that of one jumps back.

    Attributes
    ----------
    checks : dict of Topic to MessageCheck
        Validity check of each topic, which counts dropped messages.
    clock_jumps : int
        Number of times a topic's clock jumped back.
    """

    def __init__(
        self,
        selected: SelectedTopics,
        model: RobotModel,
        streams: LiveStreams,
        restart: Callable[[], None],
    ) -> None:
        self._model, self._streams, self._restart = model, streams, restart
        self.clock_jumps = 0
        self.checks = {
            topic: MessageCheck(
                topic, model, selected.mapping, takes_any_frame=selected.takes_any_frame(topic)
            )
            for topic in selected.all
        }

    def feed(self, topic: Topic, payload: bytes) -> None:
        """Add a serialised message of a topic; an invalid one is dropped and counted."""
        if topic.msgtype == BOOL:
            with suppress(DataError):
                self._streams.add_flag(topic, payload)
            return
        for stamp, usable in self.checks[topic].take(payload):
            self._feed(topic, stamp, usable)

    def _feed(self, topic: Topic, stamp: int, payload: bytes) -> None:
        streams = self._streams
        if streams.jumps_back(topic, stamp):
            logger.warning(
                "%s: its clock jumps back from %.3f s; alignment restarts and all processed data "
                "are kept, so that a bag that is played again counts twice",
                topic.name,
                (streams.buffers[topic].newest or 0) * 1e-9,
            )
            self.clock_jumps += 1
            self._restart()
        elif ahead := streams.jump_ahead(topic, stamp):
            streams.buffers[topic].pauses += 1
            logger.warning(
                "%s: its stamps jump ahead by %.1f s: its publisher paused, or its clock was set; "
                "the data of both sides are used",
                topic.name,
                ahead * 1e-9,
            )
        streams.add(topic, stamp, payload)

    def posture(self) -> FloatArray | None:
        """Return the newest joint positions (J,), rad or m; None before the first message."""
        try:
            joints = self._streams.newest_joints(POSTURE_TIME)
            columns = joint_columns(joints.names, self._model, joints.topic)
        except SymbidError:  # no message yet, or one without a joint, which is reported elsewhere
            return None
        position = joints.position[-1:, columns]
        return self._model.apply_mimics(position)[0] if np.all(np.isfinite(position)) else None
