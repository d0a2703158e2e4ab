"""Subscriptions that a thread waits for and empties itself: the shortest way from topic to array.

An executor would rebuild its wait set for every message and convert each into Python objects,
which costs a control loop of 1 kHz half of its period.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from symbid_ros.arrays import IntArray
from symbid_ros.messages.layout import Layout, Records
from symbid_ros.messages.single_message import SingleMessages
from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import read_stamp
from symbid_ros.ros.intake import Polled
from symbid_ros.ros.messages import message_class


@dataclass(frozen=True)
class Letter:
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


class Mailbox:
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
            callback_group=Polled(),
            raw=True,
        )
        name = str(self.subscription.topic_name)
        self._messages = SingleMessages(Topic(name, msgtype))

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

    def read(self, payload: bytes) -> Letter:
        """Decode one of its payloads; those laid out like a recent one cost a comparison.

        Raises
        ------
        DataError
            When it is not a message of this type.
        """
        return Letter(*self._messages.decode(payload))


def wait_for_any(node: Node, mailboxes: Sequence[Mailbox], seconds: float) -> None:
    """Sleep until one of the mailboxes holds a message, or for so many seconds."""
    handles = [mailbox.subscription.handle for mailbox in mailboxes]
    waiting = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    waiting.clear_entities()
    for handle in handles:
        waiting.add_subscription(handle)
    waiting.wait(max(0, round(seconds * 1e9)))
