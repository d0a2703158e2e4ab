"""Replay bags on their topics: the recorded bytes, in order and at the recorded times."""

import json
import struct
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import Literal

from rclpy.node import Node

from symbid_ros.bags import RecordedMessage, RecordedTopic, Recording
from symbid_ros.errors import BagError, OptionError, SymbidError
from symbid_ros.messages.layout import typestore
from symbid_ros.messages.topics import Topic, TopicSelection, TopicSelector
from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.options import check_values, option
from symbid_ros.ros.endpoints import (
    await_acknowledgement,
    await_settled,
    message_class,
)
from symbid_ros.ros.parameters import ParameterError, Values, options_from, parameters_of
from symbid_ros.ros.playback import (
    CLOCK_TOPIC,
    ReplayClock,
    ReplayControls,
    ReplayPublisher,
    ReplaySchedule,
)
from symbid_ros.ros.process import run_node
from symbid_ros.ros.reporting import OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.shutdown import interruptible

LATE = 1.0  # s behind schedule before the status becomes a warning


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Which part of which bags to replay, and how fast.

    Raises
    ------
    OptionError
        When a value is invalid, or two options contradict each other.
    """

    bag: tuple[Path, ...] = option((), "Bags to replay, merged by log time.")
    rate: float = option(
        1.0,
        "Speed, in seconds of the bag per second; 0: as fast as reliable subscribers acknowledge.",
        minimum=0.0,
        maximum=1000.0,
    )
    loop: bool = option(False, "Restart at the end of the bag; stamps then jump back.")
    start: float = option(
        0.0, "Start, counted from the first message of the bag.", unit="s", minimum=0.0
    )
    duration: float = option(
        0.0, "Length of the part to replay; 0: to the end of the bag.", unit="s", minimum=0.0
    )
    topics: tuple[str, ...] = option(
        (), "Topics to replay.", unset="all of installed types except /clock"
    )
    exclude: tuple[str, ...] = option((), "Topics not to replay.")
    publish_clock: bool = option(False, "Publish /clock for nodes that set use_sim_time.")
    clock_rate: float = option(
        100.0,
        "Rate of /clock, in messages per second of the bag.",
        unit="Hz",
        minimum=0.1,
        maximum=10000.0,
    )
    clock_source: Literal["header", "log"] = option(
        "header", "Time on /clock. header: the newest header stamp replayed; log: the log time."
    )
    wait_for_subscribers: bool = option(
        False,
        "Start when every sensor topic has a subscriber, or every topic if none is a sensor's.",
    )
    lossless: bool = option(
        True,
        "Wait for slow reliable subscribers instead of dropping messages. A `rate` of 0 always "
        "waits.",
    )
    queue_depth: int = option(
        5000,
        "Messages kept for slow subscribers if not `lossless`.",
        unit="messages",
        minimum=1,
    )

    def __post_init__(self) -> None:
        """Refuse options that are invalid or contradict each other."""
        check_values(self)
        if not self.bag:
            raise OptionError("`bag`: empty; give at least one bag", "E501")
        if self.publish_clock and "clock" in (name.lstrip("/") for name in self.topics):
            raise OptionError(
                "`topics`: `publish_clock` also publishes /clock; remove /clock from `topics` or "
                "set `publish_clock` to false",
                "E502",
            )


PARAMETERS = parameters_of(PlayOptions)


class Player:
    """Replays a recording."""

    def __init__(self, node: Node, values: Values, stop: Event) -> None:
        options = options_from(PlayOptions, values)
        with interruptible(stop):  # indexing a damaged bag takes time
            self._recording = Recording.of(options.bag)
        self._begin, self._end = _interval(options, self._recording)
        topics = _topics(options, self._recording)
        self._loop = options.loop
        self._is_lossless = options.lossless or not options.rate
        self._stop = stop

        publisher = partial(
            ReplayPublisher,
            node,
            depth=options.queue_depth,
            stop=stop,
            lossless=self._is_lossless,
        )
        self._publishers = {topic.name: publisher(topic) for topic in topics}
        self._clock: ReplayClock | None = None
        if options.publish_clock:
            self._clock = ReplayClock(publisher(CLOCK_TOPIC), options.clock_rate)
        self._shows_stamps = options.clock_source == "header"
        self._stamped = _stamped(topics) if self._clock and self._shows_stamps else set()
        self._awaited = _sensors(topics) if options.wait_for_subscribers else ()

        self._controls = ReplayControls(node)
        self._schedule = ReplaySchedule(options.rate, self._controls, stop)
        self._position, self._stamp = self._begin, -1
        self._passes = 0
        self._state = "waiting for subscribers"
        self._status_publisher = StatusPublisher(node, self._status, self._recording.source)

    def run(self) -> None:
        """Replay to the end or until stopped, then print counts as JSON."""
        if self._awaited:
            await_settled(self._subscribers, self._stop, self._other_subscribers)
        began = time.monotonic()
        while not self._stop.is_set():
            self._controls.restarted.clear()
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
        """Replay once from start to end; return False if interrupted."""
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
        """Publish /clock up to a log time; return False if interrupted."""
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
                "repair the bag with `symbid bag recover`",
                "E809",
            ) from error

    def _all_publishers(self) -> list[ReplayPublisher]:
        clock = [self._clock.publisher] if self._clock is not None else []
        return [*self._publishers.values(), *clock]

    def _subscribers(self) -> list[int]:
        return [self._publishers[name].publisher.get_subscription_count() for name in self._awaited]

    def _other_subscribers(self) -> list[int]:
        return [entry.publisher.get_subscription_count() for entry in self._all_publishers()]

    def _await_acknowledgement(self) -> None:
        """Wait until reliable subscribers have received all messages."""
        if self._is_lossless:
            for entry in self._all_publishers():
                entry.await_acknowledgement()
        await_acknowledgement((entry.publisher for entry in self._all_publishers()), self._stop)

    def _status(self) -> list[NodeStatus]:
        level, lag = OK, self._schedule.lag
        message = "paused" if self._controls.paused.is_set() else self._state
        if lag > LATE:
            level = WARN
            message += f", {lag:.1f} s behind schedule; set a lower rate"
        values = {
            "position": f"{(self._position - self._recording.start) / 1e9:.3f}",
            "length": f"{(self._recording.end - self._recording.start) / 1e9:.3f}",
            "rate": f"{self._schedule.rate:g}",
            "lag": f"{lag:.4f}",
            "passes": self._passes,
            "published": sum(entry.count for entry in self._all_publishers()),
        }
        return [NodeStatus("replay", level, message, values)]


def _topics(options: PlayOptions, recording: Recording) -> tuple[RecordedTopic, ...]:
    """Return the topics to replay.

    A named topic that cannot be replayed is an error; any other is skipped with a warning.
    """
    excluded = recording.find(options.exclude)
    wanted = recording.find(options.topics) if options.topics else recording.topics.values()
    chosen = []
    for topic in wanted:
        if topic in excluded or (not options.topics and topic.name == CLOCK_TOPIC.name):
            continue
        try:
            recording.require_cdr(topic)
            message_class(topic.msgtype)
        except SymbidError as error:
            if options.topics:
                raise
            print(f"player: {topic.name}: not replayed: {error}", file=sys.stderr)
        else:
            chosen.append(topic)
    if not chosen:
        raise BagError(
            f"{recording.source}: no topic left to replay; name topics of the bag in topics, or "
            "fewer in exclude",
            "E805",
        )
    return tuple(chosen)


def _interval(options: PlayOptions, recording: Recording) -> tuple[int, int]:
    """Return start and end of the log times to replay, ns; the end is excluded."""
    begin = recording.start + round(options.start * 1e9)
    if begin > recording.end:
        length = (recording.end - recording.start) / 1e9
        raise ParameterError(
            f"parameter start: {options.start:g} s is beyond the end of {recording.source}; "
            f"give less than {length:.3f}",
            "E804",
        )
    duration = round(options.duration * 1e9)
    return begin, begin + duration if duration else recording.end + 1


def _stamped(topics: Sequence[RecordedTopic]) -> set[str]:
    """Return the topics whose messages begin with a stamp."""
    known = typestore().fielddefs
    return {topic.name for topic in topics if topic.msgtype in known and has_stamp(topic.msgtype)}


def _sensors(topics: Sequence[RecordedTopic]) -> tuple[str, ...]:
    """Return the topics that an identifier would subscribe to, or all if there are none."""
    sensors = TopicSelector("", TopicSelection())
    names = tuple(topic.name for topic in topics)
    wanted = {topic.name for topic in topics if sensors.wants(Topic(topic.name, topic.msgtype))}
    return tuple(name for name in names if name in wanted) or names


def main() -> int:
    """Run the node ``player`` and return its exit status."""
    return run_node(
        "player",
        lambda node, values, stop: Player(node, values, stop).run(),
        purpose="Replay bags on their topics.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
