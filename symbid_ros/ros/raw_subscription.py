"""Raw subscriptions that a thread empties by polling: the fastest way from a topic to its bytes.

An executor rebuilds its wait set for every message and converts each into Python objects. That
costs a control loop of 1 kHz half of its period, and the executor loses messages where a plain
poll of every queue does not.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from symbid_ros.arrays import IntArray
from symbid_ros.messages.layout import Layout, Records
from symbid_ros.messages.single_message import SingleMessageDecoder
from symbid_ros.messages.topics import OfferedQos, Topic
from symbid_ros.messages.types import read_stamp
from symbid_ros.ros.endpoints import (
    is_compatible,
    message_class,
    recorded_qos,
    strictest_common_qos,
)

# Messages, and bytes of them, taken from one queue before the next has its turn.
BATCH = 256
BATCH_SIZE = 1 << 20


class PolledGroup(CallbackGroup):  # type: ignore[misc]
    """Keeps its subscriptions out of every executor."""

    def can_execute(self, entity: Any) -> bool:
        """Return that the executor has nothing to do here."""
        return False


class ReceivedMessage(NamedTuple):
    """One message as it came: bytes, time of receipt and of publishing in nanoseconds."""

    payload: bytes
    received: int
    published: int


@dataclass(frozen=True)
class RawSubscription:
    """Raw subscriptions to one topic: one, or more where publishers' qualities of service differ.

    Attributes
    ----------
    node : Node
    topic, msgtype : str
        Fully qualified name and type.
    depth : int
        Messages that may wait.
    group : PolledGroup
    qos : tuple of OfferedQos
        What its publishers offered when it was found.
    """

    node: Node
    topic: str
    msgtype: str
    depth: int
    group: PolledGroup
    qos: tuple[OfferedQos, ...]
    _subscriptions: list[Subscription] = field(default_factory=list)
    _returned: list[ReceivedMessage] = field(default_factory=list)
    _recent: dict[tuple[int, int], None] = field(default_factory=dict)

    def arrivals(self) -> Iterator[ReceivedMessage]:
        """Take what lies in the queues, a batch of each at most; no message twice."""
        while self._returned:
            yield self._returned.pop(0)
        for subscription in tuple(self._subscriptions):
            for arrival in _taken(subscription):
                if len(self._subscriptions) == 1 or self._is_new(arrival):
                    yield arrival

    def give_back(self, arrival: ReceivedMessage) -> None:
        """Let a message be the next to arrive."""
        self._returned.insert(0, arrival)

    def follow(self) -> None:
        """Subscribe once more where a publisher offers less than has been asked for so far."""
        offers = [each.qos_profile for each in _publishers(self.node, self.topic, self.msgtype)]
        asked = [each.qos_profile for each in self._subscriptions]
        unmet = [offer for offer in offers if not any(is_compatible(offer, one) for one in asked)]
        if unmet:
            subscription = self.node.create_subscription(
                message_class(self.msgtype),
                self.topic,
                _unused,
                strictest_common_qos(unmet, self.depth),
                callback_group=self.group,
                raw=True,
            )
            self._subscriptions.append(subscription)

    def close(self) -> None:
        """Unsubscribe."""
        while self._subscriptions:
            self.node.destroy_subscription(self._subscriptions.pop())

    def _is_new(self, arrival: ReceivedMessage) -> bool:
        """Tell whether no other of the subscriptions has brought a message already."""
        key = arrival.published, hash(arrival.payload)
        if key in self._recent:
            return False
        self._recent[key] = None
        if len(self._recent) > self.depth:
            del self._recent[next(iter(self._recent))]
        return True


def _taken(subscription: Subscription) -> Iterator[ReceivedMessage]:
    handle, kind = subscription.handle, subscription.msg_type
    size = 0
    with handle:
        for _ in range(BATCH):
            taken = None if size >= BATCH_SIZE else handle.take_message(kind, True)
            if taken is None:
                return
            payload, times = taken
            size += len(payload)
            yield ReceivedMessage(payload, times["received_timestamp"], times["source_timestamp"])


def _publishers(node: Node, topic: str, msgtype: str) -> list[TopicEndpointInfo]:
    found = node.get_publishers_info_by_topic(topic)
    return [publisher for publisher in found if publisher.topic_type == msgtype]


def _unused(message: Any) -> None:
    """Stand where rclpy wants a callback."""


def subscribe(
    node: Node, topic: str, depth: int, group: PolledGroup, msgtype: str | None = None
) -> RawSubscription | None:
    """Subscribe to a topic as its publishers offer it; None while there is none.

    Where publishers disagree about the type, it is ``msgtype``, or else the first one's.
    """
    kinds = [publisher.topic_type for publisher in node.get_publishers_info_by_topic(topic)]
    kind = msgtype or next(iter(kinds), "")
    publishers = _publishers(node, topic, kind)
    if not publishers:
        return None
    offers = tuple(recorded_qos(publisher.qos_profile) for publisher in publishers)
    intake = RawSubscription(node, topic, kind, depth, group, offers)
    intake.follow()
    return intake


@dataclass(frozen=True)
class DecodedMessage:
    """One message in numbers.

    Attributes
    ----------
    layout : Layout
        With its strings, such as joint names.
    record : (1,) record array
        Its numbers by path.
    """

    layout: Layout
    record: Records

    @property
    def stamp(self) -> int:
        """Header stamp, ns."""
        stamps: IntArray = read_stamp(self.record)
        return int(stamps[0])


class DecodedSubscription:
    """A subscription that accepts any quality of service and is polled.

    Parameters
    ----------
    node : Node
    topic, msgtype : str
        Relative name, and for example ``sensor_msgs/msg/JointState``.
    depth : int
        Messages that may wait; older ones go first.
    """

    def __init__(self, node: Node, topic: str, msgtype: str, depth: int) -> None:
        self.subscription = node.create_subscription(
            message_class(msgtype),
            topic,
            lambda message: None,
            QoSProfile(
                history=QoSHistoryPolicy.KEEP_LAST,
                depth=depth,
                reliability=QoSReliabilityPolicy.BEST_EFFORT,
            ),
            callback_group=PolledGroup(),
            raw=True,
        )
        name = str(self.subscription.topic_name)
        self._messages = SingleMessageDecoder(Topic(name, msgtype))

    @property
    def senders(self) -> int:
        """Number of publishers matched."""
        return int(self.subscription.get_publisher_count())

    def payloads(self) -> Iterator[bytes]:
        """Take what has arrived, oldest first."""
        handle, kind = self.subscription.handle, self.subscription.msg_type
        with handle:
            while (taken := handle.take_message(kind, True)) is not None:
                yield taken[0]

    def read(self, payload: bytes) -> DecodedMessage:
        """Decode one of its payloads; those laid out like a recent one cost a comparison.

        Raises
        ------
        DataError
            When it is not a message of this type.
        """
        return DecodedMessage(*self._messages.decode(payload))


def wait_for_any(node: Node, mailboxes: Sequence[DecodedSubscription], seconds: float) -> None:
    """Sleep until one of the mailboxes holds a message, or for so many seconds."""
    handles = [mailbox.subscription.handle for mailbox in mailboxes]
    waiting = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    waiting.clear_entities()
    for handle in handles:
        waiting.add_subscription(handle)
    waiting.wait(max(0, round(seconds * 1e9)))
