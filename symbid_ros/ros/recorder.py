"""Record topics into a bag without losing messages."""

import json
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

from rclpy.node import Node
from rich.console import Console
from rich.live import Live
from rich.text import Text

from symbid_ros.bags import BackgroundWriter, BagWriter, QueuedMessage, WriterState
from symbid_ros.errors import BagError, SymbidError
from symbid_ros.messages.layout import ENCAPSULATION, typestore
from symbid_ros.messages.single_message import GapCounter
from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.ros.diagnostics import ERROR, OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.ros.discovery import TopicDiscovery, TopicFilter
from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.ros.process import run_node
from symbid_ros.ros.raw_subscription import RawSubscription

REFRESH = 0.5  # s
LATE_SYNC = 5.0  # s; a healthy disk answers within milliseconds
SENSORS = ["joint_states", "imu/data", "left_foot/wrench", "right_foot/wrench"]
TRUTH = ["ground_truth/joints", "ground_truth/odom", "ground_truth/base_accel"]
POLL = 0.002  # s; far below what fills a queue
DISCOVERY_PERIOD = 0.05  # s
MEGABYTE = 10**6
EVERY_NAME = re.compile("")
STAMPED = ENCAPSULATION + 8  # bytes, at least, of a message with a stamp
SLOW = "the disk or the processor was too slow"
PARAMETERS = (
    Parameter("bag", "", "Folder of the new bag; empty for log_<date>-<time> here."),
    Parameter("topics", [*SENSORS, *TRUTH], "Topics to record as soon as they are published."),
    Parameter("all_topics", False, "Record all other topics that are not hidden, too."),
    Parameter(
        "topics_regex", "", "Record other topics, too, in whose full name this expression is found."
    ),
    Parameter("exclude_regex", "", "Record no topic in whose full name this expression is found."),
    Parameter("queue_depth", 5000, "Messages each topic may wait to be taken.", minimum=1),
    Parameter(
        "queue_size",
        256,
        "MB of messages that may wait for a slow disk; beyond, the largest topic loses messages.",
        minimum=1,
    ),
    Parameter(
        "flush_period",
        0.05,
        "Seconds that data wait to be written; a killed recorder loses no older ones.",
        minimum=0.01,
        maximum=10.0,
    ),
    Parameter(
        "sync_period",
        0.5,
        "Seconds between forcing data onto the disk, which a power cut then spares.",
        minimum=0.05,
        maximum=3600.0,
    ),
    Parameter("split_size", 0, "MB after which a new file is begun; 0 for never.", minimum=0),
    Parameter(
        "split_duration", 0.0, "Seconds after which a new file is begun; 0 for never.", minimum=0.0
    ),
    Parameter(
        "stop_when_silent",
        0.0,
        "Stop after so many seconds without a message once there was one; 0 for never.",
        minimum=0.0,
    ),
)


class RecordingProgress:
    """Watches a writer; shows one line in place on a terminal, elsewhere nothing.

    Parameters
    ----------
    bag : str
        What is being written.
    console : Console
        Where to.
    """

    def __init__(self, bag: str, console: Console) -> None:
        self._bag = bag
        self._live = (
            Live(console=console, auto_refresh=False, transient=True)
            if console.is_interactive
            else None
        )
        self._began = self._shown = time.monotonic()
        self._messages = 0
        self._rate = 0.0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, state: WriterState) -> None:
        """Bring the figures up to date, twice a second."""
        now = time.monotonic()
        if now - self._shown < REFRESH:
            return
        self._rate = (state.messages - self._messages) / (now - self._shown)
        self._shown, self._messages = now, state.messages
        if self._live is not None:
            self._live.update(self._line(state), refresh=True)

    def health(self, state: WriterState, failure: Exception | None) -> NodeStatus:
        """Return the status of the recording."""
        level, message = OK, "recording" if state.messages else "waiting for messages"
        if failure is not None:
            level, message = ERROR, str(failure)
        elif state.dropped:
            level, message = WARN, "messages dropped: the disk or the processor is too slow"
        elif state.sync_age > LATE_SYNC:
            level, message = WARN, "the disk does not keep up"
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
        # What matters most comes first: a narrow terminal shows no more.
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
class _Recording:
    """A topic being recorded."""

    subscription: RawSubscription
    topic: int
    gaps: GapCounter | None  # without stamps there is nothing to count


class Recorder:
    """Empties raw subscriptions into a bag until stopped."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        name = values["bag"] or datetime.now().strftime("log_%Y_%m_%d-%H_%M_%S")
        self._silence: float = values["stop_when_silent"]
        self._discovery = TopicDiscovery(node, _wanted(values), values["queue_depth"])
        self._recordings: list[_Recording] = []
        self._refusal: Exception | None = None
        self._bag = BagWriter(
            Path(name),
            split_size=values["split_size"] * MEGABYTE,
            split_duration=round(values["split_duration"] * 1e9),
        )
        self._writer = BackgroundWriter(
            self._bag,
            flush_period=values["flush_period"],
            sync_period=values["sync_period"],
            capacity=values["queue_size"] * MEGABYTE,
        )
        self._progress = RecordingProgress(name, Console(stderr=True, highlight=False))
        self._health = StatusPublisher(
            node,
            lambda: [self._progress.health(self._writer.state, self._writer.failure)],
            str(self._bag),
        )

    def run(self, stop: Event) -> None:
        """Record, complete the bag and say what it holds.

        Raises
        ------
        BagError
            When nothing was received, or not all of it could be written.
        """
        try:
            with self._progress:
                self._record(stop)
        finally:
            self._complete()
        if not self._writer.received:
            names = ", ".join(self._discovery.wanted.names)
            raise self._writer.failure or BagError(
                f"{self._bag.path}: no message received, nothing recorded; check topic names "
                f"and ROS_DOMAIN_ID, wanted were {names or 'those that match'}"
            )
        for topic in self._discovery.missing:
            _warn(f"{topic}: never published")
        print(json.dumps(self._summary()), flush=True)
        self._judge()

    def _record(self, stop: Event) -> None:
        # To load a message type takes tenths of a second, which no topic must wait for.
        ended = Event()
        watch = Thread(target=self._watch, args=(ended,), name="discovery", daemon=True)
        watch.start()
        try:
            self._take(stop)
        finally:
            ended.set()
            watch.join()
        if self._refusal is not None:
            raise self._refusal

    def _watch(self, ended: Event) -> None:
        try:
            while not self._discovery.is_complete and not ended.wait(DISCOVERY_PERIOD):
                self._discovery.look(self._announce, self._refuse)
        except Exception as refusal:
            self._refusal = refusal

    def _take(self, stop: Event) -> None:
        heard = None
        while not stop.is_set() and self._writer.failure is None and self._refusal is None:
            messages = self._drain()
            now = time.monotonic()
            self._progress.show(self._writer.state)
            if messages:
                heard = now
            elif self._silence and heard is not None and now - heard >= self._silence:
                return
            else:
                time.sleep(POLL)
        until = time.time_ns()
        while any(message.log_time <= until for message in self._drain()):
            pass

    def _announce(self, subscription: RawSubscription) -> None:
        topic = self._writer.add_topic(subscription.topic, subscription.msgtype, subscription.qos)
        is_stamped = subscription.msgtype in typestore().fielddefs and has_stamp(
            subscription.msgtype
        )
        self._recordings.append(
            _Recording(subscription, topic, GapCounter() if is_stamped else None)
        )

    def _refuse(self, topic: str, error: SymbidError) -> None:
        _warn(f"{topic}: not recorded: {error}")

    def _drain(self) -> list[QueuedMessage]:
        messages = []
        for recording in tuple(self._recordings):
            for received in recording.subscription.take():
                messages.append(
                    QueuedMessage(
                        recording.topic, received.received, received.published, received.payload
                    )
                )
                # Publishers are not trusted to send whole messages.
                if recording.gaps is not None and len(received.payload) >= STAMPED:
                    recording.gaps.add(read_leading_stamp(received.payload))
        if messages:
            self._writer.put(messages)
        return messages

    def _complete(self) -> None:
        if self._writer.received:
            self._writer.close()
        else:
            self._writer.discard()

    def _judge(self) -> None:
        """Raise what went wrong, with what it cost; warn of messages dropped."""
        lost = self._writer.lost
        told = ", ".join(f"{topic} {count}" for topic, count in lost.items())
        if isinstance(self._writer.failure, BagError):
            missing = "what was written last may be missing"
            if lost:
                period = ""
                if self._bag.end:
                    first, last = map(_clock_time, (self._bag.end, self._writer.latest))
                    period = f" from {first} to {last}"
                missing = f"{sum(lost.values())} messages{period} are missing ({told})"
            raise BagError(f"{self._writer.failure}: {missing}") from self._writer.failure
        if self._writer.failure is not None:
            raise self._writer.failure
        if lost:
            _warn(f"{self._bag.path}: {sum(lost.values())} messages dropped ({told}); {SLOW}")

    def _summary(self) -> dict[str, object]:
        return {
            "bag": str(self._bag.path),
            "files": self._bag.files,
            "bytes": self._bag.size,
            "recorded": self._bag.counts,
            "lost": self._writer.lost,
            "gaps": {
                recording.subscription.topic: asdict(recording.gaps.gaps)
                for recording in self._recordings
                if recording.gaps is not None
            },
        }


def _wanted(values: dict[str, Any]) -> TopicFilter:
    include = _expression("topics_regex", values)
    return TopicFilter(
        tuple(name for name in values["topics"] if name),
        EVERY_NAME if values["all_topics"] else include,
        _expression("exclude_regex", values),
    )


def _expression(name: str, values: dict[str, Any]) -> re.Pattern[str] | None:
    try:
        return re.compile(values[name]) if values[name] else None
    except re.error as error:
        raise ParameterError(
            f"parameter {name}: no regular expression ({error}); give one such as ^/camera/"
        ) from error


def _clock_time(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds / 1e9).isoformat(timespec="milliseconds")


def _warn(text: str) -> None:
    print(f"recorder: {text}", file=sys.stderr)


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
