"""Publishers of simulated instants: bytes serialised once and patched in place."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from threading import Event

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from symbid_ros.messages.layout import Columns, Records
from symbid_ros.messages.types import clock_layout, fill_stamp
from symbid_ros.ros.messages import message_class, reliable
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.topics import SimulatedTopic

SETTLE = 0.5  # s; discovery of the remaining subscribers after the needed ones are there
POLL = 0.02  # s
ACKNOWLEDGE = 20.0  # s; a subscriber that takes longer is given up, as by the middleware
FAREWELL = 0.5  # s; the same for a node that was asked to end


@dataclass
class InstantPublisher:
    """Publishes one topic every so many instants.

    Publishing typed messages costs some 0.1 ms each; the bytes of a record
    patched in place cost a fraction of that.
    """

    publisher: Publisher
    topic: SimulatedTopic
    every: int
    count: int = 0
    _record: Records = field(init=False)
    _columns: Columns = field(init=False)

    def __post_init__(self) -> None:
        self._record = self.topic.layout.records(1)
        self._columns = self.topic.layout.columns(self._record)

    @classmethod
    def create(
        cls, node: Node, topic: SimulatedTopic, *, every: int, depth: int
    ) -> "InstantPublisher":
        """Announce the topic on the node."""
        publisher = node.create_publisher(
            message_class(topic.layout.msgtype), topic.name, reliable(depth)
        )
        return cls(publisher, topic, every)

    def publish(self, step: int, instant: Instant) -> None:
        """Publish the instant if it is this topic's turn."""
        if step % self.every:
            return
        self.topic.fill(self._columns, instant.stamp, instant)
        self.publisher.publish(self._record.tobytes())
        self.count += 1


def clock_topic() -> SimulatedTopic:
    """Return ``/clock``, simulated time."""

    def fill(columns: Columns, stamp: object, instant: Instant) -> None:
        fill_stamp(columns, instant.stamp, "clock")

    return SimulatedTopic("/clock", clock_layout(), fill)


def await_subscribers(
    needed: Sequence[InstantPublisher],
    others: Sequence[InstantPublisher],
    stop: Event,
    least: int = 1,
) -> None:
    """Wait until every needed topic has ``least`` subscribers and no further one turns up."""
    await_settled(
        lambda: tuple(max(0, count - least + 1) for count in subscribers(needed)),
        stop,
        lambda: subscribers(others),
    )


def subscribers(publishers: Sequence[InstantPublisher]) -> tuple[int, ...]:
    """Return how many subscribers each has."""
    return tuple(entry.publisher.get_subscription_count() for entry in publishers)


def await_settled(
    needed: Callable[[], Sequence[int]],
    stop: Event,
    others: Callable[[], Sequence[int]] = tuple,
) -> None:
    """Wait until no count is 0 that is needed, and none has changed for a while."""
    seen: tuple[int, ...] = ()
    since = time.monotonic()
    while not stop.is_set():
        wanted = needed()
        counts = (*wanted, *others())
        if counts != seen or not all(wanted):
            seen, since = counts, time.monotonic()
        elif time.monotonic() - since >= SETTLE:
            return
        stop.wait(POLL)


def await_acknowledgement(publishers: Iterable[Publisher], stop: Event) -> None:
    """Give reliable subscribers time to fetch what is still on its way; little once stopped."""
    begun = time.monotonic()
    stopped: float | None = None
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=POLL)):
            now = time.monotonic()
            if stop.is_set():
                stopped = stopped or now
                if now - stopped > FAREWELL:
                    return
            if now - begun > ACKNOWLEDGE:
                return
