"""Topics into a bag, without losing a message."""

import json
import sys
import time
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from rclpy.node import Node

from symbid_ros.bags.gaps import find_gaps, has_stamp, stamp_of
from symbid_ros.bags.writer import BagWriter
from symbid_ros.errors import BagError
from symbid_ros.ros.intake import Discovery, Intake
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import run_node

SENSORS = ["joint_states", "imu/data", "left_foot/wrench", "right_foot/wrench"]
TRUTH = ["ground_truth/joints", "ground_truth/odom", "ground_truth/base_accel"]
POLL = 0.002  # s; far below what fills a queue
DISCOVERY_PERIOD = 0.05  # s

PARAMETERS = (
    Parameter("bag", "", "Folder of the new bag; empty for log_<date>-<time> here."),
    Parameter("topics", [*SENSORS, *TRUTH], "Topics to record as soon as they are published."),
    Parameter("queue_depth", 5000, "Messages each topic may wait to be written.", minimum=1),
    Parameter(
        "flush_period",
        0.05,
        "Seconds of data at most that a killed recorder loses.",
        minimum=0.01,
        maximum=10.0,
    ),
    Parameter(
        "stop_when_silent",
        0.0,
        "Stop after so many seconds without a message once there was one; 0 for never.",
        minimum=0.0,
    ),
)


@dataclass
class _Recording:
    """A topic being recorded."""

    intake: Intake
    channel: int
    is_stamped: bool
    stamps: "array[int]" = field(default_factory=lambda: array("q"))


class Recorder:
    """Empties raw subscriptions into a bag until stopped."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        name = values["bag"] or datetime.now().strftime("log_%Y_%m_%d-%H_%M_%S")
        self._flush_period: float = values["flush_period"]
        self._silence: float = values["stop_when_silent"]
        self._discovery = Discovery(node, tuple(values["topics"]), values["queue_depth"])
        self._recordings: list[_Recording] = []
        self._bag = BagWriter(Path(name))

    def run(self, stop: Event) -> None:
        """Record, complete the bag and say what it holds."""
        try:
            self._record(stop)
        finally:
            if any(self._bag.counts.values()):
                self._bag.close()
            else:
                self._bag.discard()
        if not any(self._bag.counts.values()):
            raise BagError(
                f"{self._bag.path}: no message received, nothing recorded; check topic names "
                f"and ROS_DOMAIN_ID, wanted were {', '.join(self._discovery.topics)}"
            )
        for topic in self._discovery.missing:
            print(f"recorder: {topic}: never published", file=sys.stderr)
        print(json.dumps(self._summary()), flush=True)

    def _record(self, stop: Event) -> None:
        now = time.monotonic()
        looked = flushed = 0.0
        heard = None
        while not stop.is_set():
            if self._discovery.missing and now - looked >= DISCOVERY_PERIOD:
                self._discovery.look(self._announce)
                looked = now
            count = self._drain()
            now = time.monotonic()
            if now - flushed >= self._flush_period:
                self._bag.flush()
                flushed = now
            if count:
                heard = now
            elif self._silence and heard is not None and now - heard >= self._silence:
                return
            else:
                time.sleep(POLL)
        while self._drain():  # what arrived before the signal
            pass

    def _announce(self, intake: Intake) -> None:
        channel = self._bag.add_topic(intake.topic, intake.msgtype, intake.qos)
        self._recordings.append(_Recording(intake, channel, has_stamp(intake.msgtype)))

    def _drain(self) -> int:
        count = 0
        for recording in self._recordings:
            for arrival in recording.intake.arrivals():
                self._bag.write(
                    recording.channel, arrival.received, arrival.payload, arrival.published
                )
                if recording.is_stamped:
                    recording.stamps.append(stamp_of(arrival.payload))
                count += 1
        return count

    def _summary(self) -> dict[str, object]:
        return {
            "bag": str(self._bag.path),
            "recorded": self._bag.counts,
            "gaps": {
                recording.intake.topic: asdict(find_gaps(np.array(recording.stamps)))
                for recording in self._recordings
                if recording.is_stamped
            },
        }


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``recorder``."""
    sys.exit(
        run_node(
            "recorder",
            lambda node, values, stop: Recorder(node, values).run(stop),
            args,
            purpose="Record topics into a rosbag2 MCAP bag.",
            parameters=PARAMETERS,
        )
    )
