"""Raw subscriptions that threads empty by polling: the fastest way from a topic to its bytes.

An executor rebuilds its wait set for every message and converts each into Python objects. That
costs a control loop of 1 kHz half of its period, and the executor loses messages where a plain
poll of every queue does not.
"""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
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

# Limits of what is taken from one queue before the next queue has its turn.
BATCH = 256  # messages
BATCH_SIZE = 1 << 20  # bytes
BACKGROUND_PERIOD = 0.1  # s between two looks at the queues, which hold seconds of messages
MOST_WAITING = 1 << 28  # bytes of messages that wait for `MessageReceiver.take`


class PolledGroup(CallbackGroup):  # type: ignore[misc]
    """Keeps its subscriptions out of every executor."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: an executor never executes these subscriptions."""
        return False


class ReceivedMessage(NamedTuple):
    """The bytes of a message with the times when it was received and published, ns."""

    payload: bytes
    received: int
    published: int


@dataclass(frozen=True)
class DecodedMessage:
    """The strings and numbers of one message.

    Attributes
    ----------
    layout : Layout
        Layout of the message, which holds its strings such as joint names.
    record : (1,) record array
        Numbers by field path.
    """

    layout: Layout
    record: Records

    @property
    def stamp(self) -> int:
        """Header stamp, ns."""
        stamps: IntArray = read_stamp(self.record)
        return int(stamps[0])


@dataclass(frozen=True)
class RawSubscription:
    """Subscribes to one topic, once for each incompatible quality of service of its publishers."""

    node: Node
    topic: str  # fully qualified name
    msgtype: str
    depth: int  # length of the queue, messages
    group: PolledGroup
    qos: tuple[OfferedQos, ...]  # profiles that the publishers offered when the topic was found
    _subscriptions: list[Subscription] = field(default_factory=list)
    _returned: list[ReceivedMessage] = field(default_factory=list)
    _recent: dict[tuple[int, int], None] = field(default_factory=dict)

    def take(self) -> Iterator[ReceivedMessage]:
        """Take at most one batch from each queue, without duplicates."""
        while self._returned:
            yield self._returned.pop(0)
        for subscription in tuple(self._subscriptions):
            for message in _take_batch(subscription):
                if len(self._subscriptions) == 1 or self._is_new(message):
                    yield message

    def put_back(self, message: ReceivedMessage) -> None:
        """Make a message the next one that is taken."""
        self._returned.insert(0, message)

    def match_publishers(self) -> None:
        """Subscribe once more if a publisher's offer matches none of the subscriptions."""
        offers = [each.qos_profile for each in _publishers(self.node, self.topic, self.msgtype)]
        requests = [each.qos_profile for each in self._subscriptions]
        unmatched = [
            offer for offer in offers if not any(is_compatible(offer, one) for one in requests)
        ]
        if unmatched:
            qos = strictest_common_qos(unmatched, self.depth)
            self._subscriptions.append(
                _subscribe_raw(self.node, self.topic, self.msgtype, qos, self.group)
            )

    def close(self) -> None:
        """Unsubscribe."""
        while self._subscriptions:
            self.node.destroy_subscription(self._subscriptions.pop())

    def _is_new(self, message: ReceivedMessage) -> bool:
        """Return whether no other subscription has delivered this message."""
        key = message.published, hash(message.payload)
        if key in self._recent:
            return False
        self._recent[key] = None
        if len(self._recent) > self.depth:
            del self._recent[next(iter(self._recent))]
        return True


class MessageBatch(NamedTuple):
    """Messages taken from all subscriptions at one time, s of the monotonic clock."""

    taken: float
    messages: tuple[tuple[Topic, ReceivedMessage], ...]


class MessageReceiver:
    """Takes the messages of subscriptions while a block computes for longer than queues last.

    A thread of the ``with`` block takes them out of the middleware's queues, which lose their
    oldest messages when they are full.
    """

    def __init__(self) -> None:
        self.subscriptions: tuple[tuple[Topic, RawSubscription], ...] = ()
        self._waiting: deque[MessageBatch] = deque()
        self._size = 0  # of the messages that wait, bytes
        self._lock = Lock()
        self._ended = Event()
        self._failure: Exception | None = None
        self._thread = Thread(target=self._take_waiting, name="receiver", daemon=True)

    def __enter__(self) -> "MessageReceiver":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def subscribe(self, subscriptions: Sequence[tuple[Topic, RawSubscription]]) -> None:
        """Take the messages of these subscriptions from now on, and no longer those of others."""
        with self._lock:
            self.subscriptions = tuple(subscriptions)
            self._waiting.clear()
            self._size = 0

    def take(self) -> MessageBatch:
        """Return the oldest messages that wait; without any, a batch from each queue."""
        with self._lock:
            if self._failure is not None:
                raise self._failure
            if not self._waiting:
                return self._take_batch()
            batch = self._waiting.popleft()
            self._size -= _size_of(batch)
            return batch

    def _take_waiting(self) -> None:
        try:
            while not self._ended.wait(BACKGROUND_PERIOD):
                while self._keep_batch():
                    pass
        except Exception as failure:  # raised where the messages are needed
            self._failure = failure

    def _keep_batch(self) -> bool:
        """Keep a batch from each queue; return whether the queues may hold more."""
        with self._lock:
            if self._size >= MOST_WAITING:
                return False
            batch = self._take_batch()
            if batch.messages:
                self._waiting.append(batch)
                self._size += _size_of(batch)
            return len(batch.messages) >= BATCH

    def _take_batch(self) -> MessageBatch:
        messages = [(topic, one) for topic, queue in self.subscriptions for one in queue.take()]
        return MessageBatch(time.monotonic(), tuple(messages))


def _size_of(batch: MessageBatch) -> int:
    return sum(len(message.payload) for _, message in batch.messages)


class DecodedSubscription:
    """Subscribes with best effort, which matches every publisher, and decodes the messages.

    A full queue drops the oldest message.
    """

    def __init__(self, node: Node, topic: str, msgtype: str, depth: int) -> None:
        qos = QoSProfile(
            history=QoSHistoryPolicy.KEEP_LAST,
            depth=depth,
            reliability=QoSReliabilityPolicy.BEST_EFFORT,
        )
        self.subscription = _subscribe_raw(node, topic, msgtype, qos, PolledGroup())
        name = str(self.subscription.topic_name)
        self._messages = SingleMessageDecoder(Topic(name, msgtype))

    @property
    def publisher_count(self) -> int:
        """Number of matched publishers."""
        return int(self.subscription.get_publisher_count())

    def take(self) -> Iterator[bytes]:
        """Take all messages from the queue, oldest first."""
        handle, kind = self.subscription.handle, self.subscription.msg_type
        with handle:
            while (taken := handle.take_message(kind, True)) is not None:
                yield taken[0]

    def decode(self, payload: bytes) -> DecodedMessage:
        """Decode a message, or raise a DataError; a recent layout costs only a comparison."""
        return DecodedMessage(*self._messages.decode(payload))


def subscribe(
    node: Node, topic: str, depth: int, group: PolledGroup, msgtype: str | None = None
) -> RawSubscription | None:
    """Subscribe to a topic with the QoS of its publishers; return None if it has no publisher.

    Publishers of another type than ``msgtype``, by default the first publisher's, are ignored.
    """
    kinds = [publisher.topic_type for publisher in node.get_publishers_info_by_topic(topic)]
    kind = msgtype or next(iter(kinds), "")
    publishers = _publishers(node, topic, kind)
    if not publishers:
        return None
    offers = tuple(recorded_qos(publisher.qos_profile) for publisher in publishers)
    subscription = RawSubscription(node, topic, kind, depth, group, offers)
    subscription.match_publishers()
    return subscription


def wait_for_any(node: Node, subscriptions: Sequence[DecodedSubscription], timeout: float) -> None:
    """Sleep until a message arrives on one of the subscriptions, at most ``timeout`` seconds."""
    handles = [each.subscription.handle for each in subscriptions]
    wait_set = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    wait_set.clear_entities()
    for handle in handles:
        wait_set.add_subscription(handle)
    wait_set.wait(max(0, round(timeout * 1e9)))


def _subscribe_raw(
    node: Node, topic: str, msgtype: str, qos: QoSProfile, group: PolledGroup
) -> Subscription:
    return node.create_subscription(
        message_class(msgtype),
        topic,
        lambda message: None,  # never called, but rclpy requires a callback
        qos,
        callback_group=group,
        raw=True,
    )


def _publishers(node: Node, topic: str, msgtype: str) -> list[TopicEndpointInfo]:
    found = node.get_publishers_info_by_topic(topic)
    return [publisher for publisher in found if publisher.topic_type == msgtype]


def _take_batch(subscription: Subscription) -> Iterator[ReceivedMessage]:
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
