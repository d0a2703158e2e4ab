"""Subscriptions that a thread waits for and empties itself: the shortest way from topic to array.

An executor would rebuild its wait set for every message and convert each into Python objects,
which costs a control loop of 1 kHz half of its period.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

from symbid_ros.arrays import IntArray
from symbid_ros.bags.container.blocks import Topic
from symbid_ros.bags.layout import Layout, Records
from symbid_ros.bags.messages import read_stamp
from symbid_ros.bags.streams.decoder import TopicDecoder
from symbid_ros.errors import DataError
from symbid_ros.ros.intake import Polled
from symbid_ros.ros.messages import message_class

TRAILING = 8  # bytes that Fast CDR may pad behind the last field


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
        self._msgtype = msgtype
        self._layout: Layout | None = None
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
        """Decode one of its payloads; those laid out like the one before cost a comparison.

        Raises
        ------
        DataError
            When it is not a message of this type.
        """
        layout = self._layout
        if layout is None or not _follows(payload, layout):
            return self._learn(payload)
        return Letter(layout, np.frombuffer(payload[: len(layout.template)], dtype=layout.dtype))

    def _learn(self, payload: bytes) -> Letter:
        topic = str(self.subscription.topic_name)
        decoder = TopicDecoder(topic, Topic(topic, self._msgtype))
        try:
            decoder.add(np.frombuffer(payload, dtype=np.uint8), np.array([[0, len(payload)]]))
        except DataError as error:
            raise DataError(
                f"{topic}: a message is not a valid {self._msgtype}; check its publisher"
            ) from error
        (piece,) = decoder.pieces
        self._layout = piece.layout
        return Letter(piece.layout, piece.records)


def wait_for_any(node: Node, mailboxes: Sequence[Mailbox], seconds: float) -> None:
    """Sleep until one of the mailboxes holds a message, or for so many seconds."""
    handles = [mailbox.subscription.handle for mailbox in mailboxes]
    waiting = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    waiting.clear_entities()
    for handle in handles:
        waiting.add_subscription(handle)
    waiting.wait(max(0, round(seconds * 1e9)))


def _follows(payload: bytes, layout: Layout) -> bool:
    size = len(layout.template)
    if not 0 <= len(payload) - size <= TRAILING:
        return False
    row = np.frombuffer(payload[:size], dtype=np.uint8)
    return bool(layout.matches(row[None, :])[0])
