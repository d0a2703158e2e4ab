"""Raw subscriptions that are emptied by polling instead of by an executor.

An executor rebuilds its wait set for every message and loses messages where a
plain poll that empties every queue does not.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription

from symbid_ros.bags.metadata import OfferedQos
from symbid_ros.ros.messages import matching, message_class, offered

# Messages, and bytes of them, taken from one queue before the next has its turn.
BATCH = 256
BATCH_SIZE = 1 << 20


class Polled(CallbackGroup):  # type: ignore[misc]
    """Keeps its subscriptions out of every executor."""

    def can_execute(self, entity: Any) -> bool:
        """Return that the executor has nothing to do here."""
        return False


class Arrival(NamedTuple):
    """One message as it came: bytes, time of receipt and of publishing in nanoseconds."""

    payload: bytes
    received: int
    published: int


@dataclass(frozen=True)
class Intake:
    """A raw subscription.

    Attributes
    ----------
    topic, msgtype : str
        Fully qualified name and type.
    qos : tuple of OfferedQos
        What its publishers offered when it was found.
    """

    topic: str
    msgtype: str
    qos: tuple[OfferedQos, ...]
    _subscription: Subscription

    def arrivals(self) -> Iterator[Arrival]:
        """Take what lies in the queue, a batch at most."""
        handle, kind = self._subscription.handle, self._subscription.msg_type
        size = 0
        with handle:
            for _ in range(BATCH):
                taken = None if size >= BATCH_SIZE else handle.take_message(kind, True)
                if taken is None:
                    return
                payload, times = taken
                size += len(payload)
                yield Arrival(payload, times["received_timestamp"], times["source_timestamp"])


def _unused(message: Any) -> None:
    """Stand where rclpy wants a callback."""


def subscribe(node: Node, topic: str, depth: int, group: Polled) -> Intake | None:
    """Subscribe to a topic as its publishers offer it; None while there is none."""
    publishers = node.get_publishers_info_by_topic(topic)
    if not publishers:
        return None
    profiles = [publisher.qos_profile for publisher in publishers]
    msgtype = publishers[0].topic_type
    subscription = node.create_subscription(
        message_class(msgtype),
        topic,
        _unused,
        matching(profiles, depth),
        callback_group=group,
        raw=True,
    )
    return Intake(topic, msgtype, tuple(map(offered, profiles)), subscription)
