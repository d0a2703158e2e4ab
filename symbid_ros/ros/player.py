"""Bags onto topics again: the recorded bytes, in order and in time."""

import json
import struct
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from symbid_ros.bags import RecordedMessage, RecordedTopic, Recording
from symbid_ros.errors import BagError, SymbidError
from symbid_ros.messages.layout import typestore
from symbid_ros.messages.topics import Topic, TopicSelection, TopicSelector
from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.ros.endpoints import (
    await_acknowledgement,
    await_settled,
    message_class,
    reliable_qos,
)
from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.ros.playback import (
    CLOCK_TOPIC,
    ReplayClock,
    ReplayControls,
    ReplayPublisher,
    ReplaySchedule,
)
from symbid_ros.ros.process import run_node
from symbid_ros.shutdown import interruptible

LATE = 1.0  # s behind schedule, worth a warning

PARAMETERS = (
    Parameter("bag", [""], "Bags to replay, merged by log time."),
    Parameter(
        "rate",
        1.0,
        "Seconds of the bag per second; 0: as fast as reliable subscribers acknowledge.",
        minimum=0.0,
        maximum=1000.0,
    ),
    Parameter("loop", False, "Begin again at the end; stamps jump back."),
    Parameter("start", 0.0, "Where to begin, s after the bag's first message.", minimum=0.0),
    Parameter("duration", 0.0, "How much to replay, s of the bag; 0: to its end.", minimum=0.0),
    Parameter(
        "topics", [""], "Topics to replay; empty for all but /clock whose type is installed."
    ),
    Parameter("exclude", [""], "Topics not to replay."),
    Parameter("publish_clock", False, "Publish /clock, for nodes with use_sim_time."),
    Parameter(
        "clock_rate",
        100.0,
        "/clock messages per second of the bag.",
        minimum=0.1,
        maximum=10000.0,
    ),
    Parameter(
        "clock_source",
        "header",
        "What /clock shows: the newest header stamp replayed, or the time of recording.",
        choices=("header", "log"),
    ),
    Parameter(
        "wait_for_subscribers",
        False,
        "Begin once every sensor topic, or every topic if none is a sensor's, has a subscriber.",
    ),
    Parameter(
        "lossless",
        True,
        "Wait for slow reliable subscribers rather than skip what they have not got; a rate of 0 "
        "always does.",
    ),
    Parameter(
        "queue_depth", 5000, "Messages kept for a slow subscriber if not lossless.", minimum=1
    ),
)


class Player:
    """Replays a recording and says what it published."""

    def __init__(self, node: Node, values: dict[str, Any], stop: Event) -> None:
        with interruptible(stop):  # a damaged bag is searched through
            self._recording = Recording.of([Path(bag) for bag in _bags(values)])
        self._begin, self._end = _interval(values, self._recording)
        topics = _topics(values, self._recording)
        self._loop: bool = values["loop"]
        self._is_patient = values["lossless"] or not values["rate"]
        self._stop = stop

        offer = partial(
            ReplayPublisher,
            node,
            depth=values["queue_depth"],
            stop=stop,
            patient=self._is_patient,
        )
        self._publishers = {topic.name: offer(topic) for topic in topics}
        self._clock: ReplayClock | None = None
        if values["publish_clock"]:
            self._clock = ReplayClock(offer(CLOCK_TOPIC), values["clock_rate"])
        self._shows_stamps = values["clock_source"] == "header"
        self._stamped = _stamped(topics) if self._clock and self._shows_stamps else set()
        self._awaited = _sensors(topics) if values["wait_for_subscribers"] else ()

        self._transport = ReplayControls(node)
        self._schedule = ReplaySchedule(values["rate"], self._transport, stop)
        self._position, self._stamp = self._begin, -1
        self._passes = 0
        self._state = "waiting for subscribers"
        self._node = node
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", reliable_qos(10))
        # The node's own clock may be the one that is being replayed.
        node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def run(self) -> None:
        """Replay to the end or until stopped."""
        if self._awaited:
            await_settled(self._subscribers, self._stop, self._other_subscribers)
        began = time.monotonic()
        while not self._stop.is_set():
            self._transport.restarted.clear()
            self._state = "playing"
            if not self._play():
                continue
            self._passes += 1
            if not self._loop:
                break
        self._state = "finished"
        self._await_acknowledgement()
        summary = {
            "bag": self._recording.source,
            "published": {
                entry.publisher.topic_name: entry.count for entry in self._all_publishers()
            },
            "passes": self._passes,
            "wall_time": round(time.monotonic() - began, 3),
            "longest_lag": round(self._schedule.longest_lag, 4),
        }
        print(json.dumps(summary), flush=True)

    def _play(self) -> bool:
        """Replay once from beginning to end; return False if interrupted."""
        self._schedule.begin(self._begin)
        self._stamp = -1
        if self._clock is not None:
            self._clock.begin(self._begin)
        messages = self._recording.messages(self._publishers, self._begin, self._end)
        for message in messages:
            if self._clock is not None and not self._tick(self._clock, message.log_time):
                return False
            if not self._schedule.reach(message.log_time):
                return False
            self._publishers[message.topic].publish(message.payload)
            self._position = message.log_time
            if message.topic in self._stamped:
                self._stamp = max(self._stamp, self._stamp_of(message))
        return True

    def _tick(self, clock: ReplayClock, log_time: int) -> bool:
        """Publish what is due on /clock up to a log time; return False if interrupted."""
        while clock.due <= log_time:
            if not self._schedule.reach(clock.due):
                return False
            clock.tick(self._stamp if self._shows_stamps else clock.due)
        return True

    def _stamp_of(self, message: RecordedMessage) -> int:
        try:
            return read_leading_stamp(message.payload)
        except (struct.error, IndexError) as error:
            raise BagError(
                f"{self._recording.source}: {message.topic}: a message is too short for its type; "
                "the bag is damaged"
            ) from error

    def _all_publishers(self) -> list[ReplayPublisher]:
        clock = [self._clock.publisher] if self._clock is not None else []
        return [*self._publishers.values(), *clock]

    def _subscribers(self) -> list[int]:
        return [self._publishers[name].publisher.get_subscription_count() for name in self._awaited]

    def _other_subscribers(self) -> list[int]:
        return [entry.publisher.get_subscription_count() for entry in self._all_publishers()]

    def _await_acknowledgement(self) -> None:
        """Give reliable subscribers time to fetch what is still on its way."""
        if self._is_patient:
            for entry in self._all_publishers():
                entry.await_acknowledgement()
        await_acknowledgement((entry.publisher for entry in self._all_publishers()), self._stop)

    def _report(self) -> None:
        """Publish the state, in the executor's thread."""
        status = DiagnosticStatus(
            name=f"{self._node.get_fully_qualified_name()}: replay",
            hardware_id=self._recording.source,
            level=DiagnosticStatus.OK,
            message="paused" if self._transport.paused.is_set() else self._state,
        )
        lag = self._schedule.lag
        if lag > LATE:
            status.level = DiagnosticStatus.WARN
            status.message += f", {lag:.1f} s behind; give a lower rate"
        facts = {
            "position": f"{(self._position - self._recording.start) / 1e9:.3f}",
            "length": f"{(self._recording.end - self._recording.start) / 1e9:.3f}",
            "rate": f"{self._schedule.rate:g}",
            "lag": f"{lag:.4f}",
            "passes": str(self._passes),
            "published": str(sum(entry.count for entry in self._all_publishers())),
        }
        status.values = [KeyValue(key=key, value=value) for key, value in facts.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _bags(values: dict[str, Any]) -> list[str]:
    bags = [bag for bag in values["bag"] if bag]
    if not bags:
        raise ParameterError("parameter bag: empty; give -p bag:=[PATH]")
    return bags


def _topics(values: dict[str, Any], recording: Recording) -> tuple[RecordedTopic, ...]:
    """Return the topics to replay.

    Topics that are named must be replayable; of the others those that are not are skipped with a
    warning.
    """
    named = [name for name in values["topics"] if name]
    if values["publish_clock"] and "clock" in (name.lstrip("/") for name in named):
        raise ParameterError(
            "parameter topics: /clock is also published anew; leave it out or set publish_clock "
            "to false"
        )
    excluded = recording.find([name for name in values["exclude"] if name])
    wanted = recording.find(named) if named else tuple(recording.topics.values())
    chosen = []
    for topic in wanted:
        if topic in excluded or (not named and topic.name == CLOCK_TOPIC.name):
            continue
        try:
            recording.require_cdr(topic)
            message_class(topic.msgtype)
        except SymbidError as error:
            if named:
                raise
            print(f"player: {topic.name}: not replayed: {error}", file=sys.stderr)
        else:
            chosen.append(topic)
    if not chosen:
        raise BagError(
            f"{recording.source}: no topic left to replay; name some in topics, or fewer in exclude"
        )
    return tuple(chosen)


def _interval(values: dict[str, Any], recording: Recording) -> tuple[int, int]:
    """Return the first log time to replay and the first not to."""
    begin = recording.start + round(values["start"] * 1e9)
    if begin > recording.end:
        length = (recording.end - recording.start) / 1e9
        raise ParameterError(
            f"parameter start: {values['start']:g} s is beyond the end of {recording.source}; "
            f"give less than {length:.3f}"
        )
    duration = round(values["duration"] * 1e9)
    return begin, begin + duration if duration else recording.end + 1


def _stamped(topics: Sequence[RecordedTopic]) -> set[str]:
    """Return the topics whose messages begin with a stamp."""
    known = typestore().fielddefs
    return {topic.name for topic in topics if topic.msgtype in known and has_stamp(topic.msgtype)}


def _sensors(topics: Sequence[RecordedTopic]) -> tuple[str, ...]:
    """Return the topics that an identification subscribes to; all if there is none."""
    sensors = TopicSelector("", TopicSelection())
    names = tuple(topic.name for topic in topics)
    wanted = {topic.name for topic in topics if sensors.wants(Topic(topic.name, topic.msgtype))}
    return tuple(name for name in names if name in wanted) or names


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``player``."""
    sys.exit(
        run_node(
            "player",
            lambda node, values, stop: Player(node, values, stop).run(),
            args,
            purpose="Replay bags on their topics.",
            parameters=PARAMETERS,
        )
    )
