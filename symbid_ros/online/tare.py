"""A tare from live messages: what unloaded wrench sensors read now."""

import logging
from collections.abc import Mapping

from symbid_ros.errors import DataError
from symbid_ros.identification.calibration.tares import Tare, tares_of
from symbid_ros.messages.sensor_streams import build_wrench_stream
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.online.live_streams import TopicBuffer
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.signals.defects import CLOCK_JUMP, DefectCounts

logger = logging.getLogger(__name__)

SOURCE = "live topics"
FEWEST = 10  # messages of a sensor


class TareRecording:
    """Messages of a robot's wrench sensors while nothing touches them.

    Parameters
    ----------
    selected : SelectedTopics
        The robot's sensors.
    checks : mapping of Topic to MessageCheck
        Checks of their messages.
    """

    def __init__(self, selected: SelectedTopics, checks: Mapping[Topic, MessageCheck]) -> None:
        self._selected, self._checks = selected, checks
        # The clock of a bag that is played again and again jumps back, after which a run begins.
        self._runs = {topic: [TopicBuffer(topic)] for topic in selected.wrenches}

    def add(self, topic: Topic, payload: bytes) -> None:
        """Add a message; those of other sensors and invalid ones are dropped."""
        if topic not in self._runs:
            return
        runs = self._runs[topic]
        for stamp, usable in self._checks[topic].take(payload):
            newest = runs[-1].newest
            if newest is not None and stamp < newest - CLOCK_JUMP:
                runs.append(TopicBuffer(topic))
            runs[-1].add(stamp, usable)

    def tares(self) -> dict[str, Tare]:
        """Return the readings of the unloaded sensors, by frame.

        Raises
        ------
        DataError
            When no sensor was unloaded, or a reading is NaN or infinite.
        """
        wrenches = []
        for topic, runs in self._runs.items():
            buffer = max(runs, key=lambda one: len(one.stamps))
            stamps = buffer.stamps
            if len(stamps) < FEWEST:
                logger.warning("%s: no messages for the tare; check its driver", topic.name)
                continue
            decoder = buffer.decoder(SOURCE, int(stamps.min()), int(stamps.max()) + 1)
            stream = build_wrench_stream(decoder, DefectCounts(SOURCE, topic.name))
            wrenches.append(self._selected.mapping.converted_wrench(stream))
        if not wrenches:
            raise DataError(
                f"{SOURCE}: no wrench sensor published during the tare; start the drivers", "E514"
            )
        return tares_of(wrenches, SOURCE)
