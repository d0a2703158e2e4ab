"""Record topics into a bag without losing messages."""

import json
import re
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from threading import Event, Thread

from rclpy.node import Node
from rich.console import Console
from rich.live import Live
from rich.text import Text

from symbid_ros.bags import BackgroundWriter, BagWriter, QueuedMessage, WriterState
from symbid_ros.errors import BagError, OptionError, SymbidError
from symbid_ros.messages.layout import ENCAPSULATION, typestore
from symbid_ros.messages.single_message import GapCounter
from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.options import check_values, option
from symbid_ros.ros.discovery import TopicDiscovery, TopicFilter
from symbid_ros.ros.parameters import Values, options_from, parameters_of
from symbid_ros.ros.process import run_node
from symbid_ros.ros.raw_subscription import RawSubscription
from symbid_ros.ros.reporting import ERROR, OK, WARN, NodeStatus, StatusPublisher

REFRESH = 0.5  # s
LATE_SYNC = 5.0  # s; a healthy disk syncs within milliseconds
POLL = 0.002  # s; queues take far longer to fill
DISCOVERY_PERIOD = 0.05  # s
MATCHING_PERIOD = 1.0  # s; a driver may restart with another quality of service
MEGABYTE = 10**6
STAMPED = ENCAPSULATION + 8  # smallest size of a message with a stamp, bytes
SLOW = "the disk or the processor was too slow"
SENSORS = "joint_states", "imu/data", "left_foot/wrench", "right_foot/wrench"
TRUTH = "ground_truth/joints", "ground_truth/odom", "ground_truth/base_accel"


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """Which topics to record, and how to write the bag.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    bag: Path | None = option(
        None, "Folder of the new bag.", unset="log_<date>-<time> in the current folder"
    )
    topics: tuple[str, ...] = option(
        (*SENSORS, *TRUTH), "Topics to record, each as soon as it has a publisher."
    )
    all_topics: bool = option(False, "Record all other topics that are not hidden as well.")
    topics_regex: str = option(
        "", "Also record topics whose full name contains a match of this regular expression."
    )
    exclude_regex: str = option(
        "", "Do not record topics whose full name contains a match of this regular expression."
    )
    queue_depth: int = option(
        5000, "Length of each topic's queue in the middleware.", unit="messages", minimum=1
    )
    queue_size: int = option(
        256,
        "Size of the queue of messages that wait for the disk. When it is full, the topic with "
        "the most bytes in it loses messages.",
        unit="MB",
        minimum=1,
    )
    flush_period: float = option(
        0.05,
        "Longest time until data are written; a killed recorder loses only newer data.",
        unit="s",
        minimum=0.01,
        maximum=10.0,
    )
    sync_period: float = option(
        0.5,
        "Time between two syncs to the disk; a power cut loses only newer data.",
        unit="s",
        minimum=0.05,
        maximum=3600.0,
    )
    split_size: int = option(
        0, "Size after which a new file is started; 0: never.", unit="MB", minimum=0
    )
    split_duration: float = option(
        0.0, "Time after which a new file is started; 0: never.", unit="s", minimum=0.0
    )
    stop_when_silent: float = option(
        0.0,
        "Stop when no message has arrived for this time since the last one; 0: never.",
        unit="s",
        minimum=0.0,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
        for name in ("topics_regex", "exclude_regex"):
            try:
                re.compile(getattr(self, name))
            except re.error as error:
                raise OptionError(
                    f"`{name}`: invalid regular expression ({error}); give one such as ^/camera/",
                    "E501",
                ) from error


PARAMETERS = parameters_of(RecordOptions)


class RecordingProgress:
    """Shows the progress of a writer in one line of a terminal; without a terminal, nothing.

    The context manager ``display`` keeps the line on the terminal.
    """

    def __init__(self, bag: str, console: Console) -> None:
        self._bag = bag
        self._live = (
            Live(console=console, auto_refresh=False, transient=True)
            if console.is_interactive
            else None
        )
        self.display: AbstractContextManager[object] = self._live or nullcontext()
        self._began = self._shown = time.monotonic()
        self._messages = 0
        self._rate = 0.0

    def show(self, state: WriterState) -> None:
        """Update the line twice a second."""
        now = time.monotonic()
        if now - self._shown < REFRESH:
            return
        self._rate = (state.messages - self._messages) / (now - self._shown)
        self._shown, self._messages = now, state.messages
        if self._live is not None:
            self._live.update(self._line(state), refresh=True)

    def status(self, state: WriterState, failure: Exception | None) -> NodeStatus:
        """Return the status for ``/diagnostics``."""
        level, message = OK, "recording" if state.messages else "waiting for messages"
        if failure is not None:
            level, message = ERROR, str(failure)
        elif state.dropped:
            level, message = WARN, "messages dropped: the disk or the processor is too slow"
        elif state.sync_age > LATE_SYNC:
            level, message = WARN, "the disk is too slow"
        values = {
            "bag": self._bag,
            "messages": state.messages,
            "bytes": state.size,
            "rate": f"{self._rate:.1f}",
            "queued": state.queued,
            "dropped": sum(state.dropped.values()),
            "sync_age": f"{state.sync_age:.2f}",
        } | {f"dropped {topic}": count for topic, count in state.dropped.items()}
        return NodeStatus("recording", level, message, values)

    def _line(self, state: WriterState) -> Text:
        # The most important values come first, because a narrow terminal cuts the line.
        parts = [
            f"{self._shown - self._began:.0f} s",
            f"{state.size / 1e6:.1f} MB",
            f"{self._rate:.0f} messages/s",
            f"{state.messages} messages",
            self._bag,
        ]
        if state.dropped:
            parts.insert(0, f"{sum(state.dropped.values())} dropped")
        text = Text("recording  " + "  ".join(parts), no_wrap=True, overflow="ellipsis")
        if state.dropped:
            text.stylize("red")
        return text


@dataclass
class _RecordedTopic:
    subscription: RawSubscription
    index: int  # of the topic in the writer
    gaps: GapCounter | None  # None for messages without stamps


class Recorder:
    """Writes the messages of raw subscriptions into a bag until stopped."""

    def __init__(self, node: Node, values: Values) -> None:
        options = options_from(RecordOptions, values)
        path = options.bag or Path(datetime.now().strftime("log_%Y_%m_%d-%H_%M_%S"))
        self._silence = options.stop_when_silent
        self._discovery = TopicDiscovery(node, _topic_filter(options), options.queue_depth)
        self._topics: list[_RecordedTopic] = []
        self._discovery_error: Exception | None = None
        self._bag = BagWriter(
            path,
            split_size=options.split_size * MEGABYTE,
            split_duration=round(options.split_duration * 1e9),
        )
        self._writer = BackgroundWriter(
            self._bag,
            flush_period=options.flush_period,
            sync_period=options.sync_period,
            capacity=options.queue_size * MEGABYTE,
        )
        self._progress = RecordingProgress(str(path), Console(stderr=True, highlight=False))
        self._status_publisher = StatusPublisher(
            node,
            lambda: [self._progress.status(self._writer.state, self._writer.failure)],
            str(self._bag),
        )

    def run(self, stop: Event) -> None:
        """Record until stopped, complete the bag and print its contents as JSON.

        Raises
        ------
        BagError
            When no message was received or not all messages could be written.
        """
        try:
            with self._progress.display:
                self._record(stop)
        finally:
            self._complete()
        if not self._writer.received:
            names = ", ".join(self._discovery.wanted.names)
            raise self._writer.failure or BagError(
                f"{self._bag.path}: no message received, nothing recorded; check ROS_DOMAIN_ID and "
                f"the topics to record: {names or 'those that match'}",
                "E807",
            )
        for topic in self._discovery.missing:
            _warn(f"{topic}: never published")
        print(json.dumps(self._summary()), flush=True)
        self._report_losses()

    def _record(self, stop: Event) -> None:
        # Loading a message type takes tenths of a second, so discovery runs in a second thread.
        ended = Event()
        discovery = Thread(target=self._discover, args=(ended,), name="discovery", daemon=True)
        discovery.start()
        try:
            self._receive(stop)
        finally:
            ended.set()
            discovery.join()
        if self._discovery_error is not None:
            raise self._discovery_error

    def _discover(self, ended: Event) -> None:
        matched = time.monotonic()
        try:
            while not ended.wait(DISCOVERY_PERIOD):
                if not self._discovery.is_complete:
                    self._discovery.update(self._add_topic, self._skip_topic)
                if time.monotonic() - matched >= MATCHING_PERIOD:
                    for topic in self._topics:
                        topic.subscription.match_publishers()
                    matched = time.monotonic()
        except Exception as error:
            self._discovery_error = error

    def _receive(self, stop: Event) -> None:
        newest = None
        while not (stop.is_set() or self._writer.failure or self._discovery_error):
            messages = self._drain()
            now = time.monotonic()
            self._progress.show(self._writer.state)
            if messages:
                newest = now
            elif self._silence and newest is not None and now - newest >= self._silence:
                return
            else:
                time.sleep(POLL)
        until = time.time_ns()
        while any(message.log_time <= until for message in self._drain()):
            pass

    def _add_topic(self, subscription: RawSubscription) -> None:
        kind = subscription.msgtype
        index = self._writer.add_topic(subscription.topic, kind, subscription.qos)
        is_stamped = kind in typestore().fielddefs and has_stamp(kind)
        gaps = GapCounter() if is_stamped else None
        self._topics.append(_RecordedTopic(subscription, index, gaps))

    def _skip_topic(self, topic: str, error: SymbidError) -> None:
        _warn(f"{topic}: not recorded: {error}")

    def _drain(self) -> list[QueuedMessage]:
        messages = []
        for topic in tuple(self._topics):
            for payload, received, published in topic.subscription.take():
                messages.append(QueuedMessage(topic.index, received, published, payload))
                # A publisher may send truncated messages.
                if topic.gaps is not None and len(payload) >= STAMPED:
                    topic.gaps.add(read_leading_stamp(payload))
        if messages:
            self._writer.put(messages)
        return messages

    def _complete(self) -> None:
        if self._writer.received:
            self._writer.close()
        else:
            self._writer.discard()

    def _report_losses(self) -> None:
        """Raise an error if writing failed, with what is missing; warn of dropped messages."""
        lost = self._writer.lost
        counts = ", ".join(f"{topic} {count}" for topic, count in lost.items())
        if isinstance(self._writer.failure, BagError):
            missing = "the newest messages may be missing"
            if lost:
                period = ""
                if self._bag.end:
                    first, last = map(_clock_time, (self._bag.end, self._writer.latest))
                    period = f" from {first} to {last}"
                missing = f"{sum(lost.values())} messages{period} are missing ({counts})"
            raise BagError(f"{self._writer.failure}: {missing}", "E808") from self._writer.failure
        if self._writer.failure is not None:
            raise self._writer.failure
        if lost:
            _warn(f"{self._bag.path}: {sum(lost.values())} messages dropped ({counts}); {SLOW}")

    def _summary(self) -> dict[str, object]:
        return {
            "bag": str(self._bag.path),
            "files": self._bag.files,
            "bytes": self._bag.size,
            "recorded": self._bag.counts,
            "lost": self._writer.lost,
            "gaps": {
                topic.subscription.topic: asdict(topic.gaps.gaps)
                for topic in self._topics
                if topic.gaps is not None
            },
        }


def _topic_filter(options: RecordOptions) -> TopicFilter:
    pattern = "" if options.all_topics else options.topics_regex
    return TopicFilter(
        tuple(name for name in options.topics if name),
        re.compile(pattern) if options.all_topics or pattern else None,
        re.compile(options.exclude_regex) if options.exclude_regex else None,
    )


def _clock_time(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds / 1e9).isoformat(timespec="milliseconds")


def _warn(text: str) -> None:
    print(f"recorder: {text}", file=sys.stderr)


def main() -> int:
    """Run the node ``recorder`` and return its exit status."""
    return run_node(
        "recorder",
        lambda node, values, stop: Recorder(node, values).run(stop),
        purpose="Record topics into a rosbag2 MCAP bag.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
