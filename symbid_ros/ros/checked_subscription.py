"""Subscriptions whose messages are decoded here, where a malformed one can be reported."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from symbid_ros.errors import DataError


def checked_subscription(
    node: Node, kind: type[Any], topic: str, callback: Callable[[Any], None], qos: QoSProfile
) -> Subscription:
    """Subscribe with a callback that only gets valid messages.

    The middleware drops malformed messages of a typed subscription without a word to the node
    and fills the terminal instead. Here they raise, and the node's `MessageExecutor` counts and
    reports them.
    """

    def decode(payload: bytes) -> None:
        try:
            message = deserialize_message(payload, kind)
        except Exception as error:  # of no common base: rmw's own, or Unicode's
            raise DataError(f"it is not a valid {kind.__name__}") from error
        callback(message)

    return node.create_subscription(kind, topic, decode, qos, raw=True)
