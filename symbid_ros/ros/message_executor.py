"""An executor that no message can end."""

from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor, await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from symbid_ros.errors import DataError

WARNING_PERIOD = 5.0  # s between two warnings

Work = Callable[[], Coroutine[Any, Any, None]]


class MessageExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """Drops and counts the messages that do not decode or that their callback cannot use.

    rclpy lets such an exception end the thread that spins: a negative time on ``/clock`` ends
    every node that follows it. Malformed bytes are dropped by the middleware without a word to the
    node, therefore they are decoded here. Exceptions of timers and services still end the node.

    Attributes
    ----------
    dropped : Counter of str
        Messages dropped, by topic.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.dropped: Counter[str] = Counter()

    def _take_subscription(self, subscription: Subscription) -> Work | None:
        try:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, True)
        except rclpy_implementation.InvalidHandle:  # destroyed meanwhile
            return None
        if taken is None:
            return None
        payload, details = taken

        async def work() -> None:
            try:
                message = payload if subscription.raw else _decoded(payload, subscription.msg_type)
                wants_details = (
                    subscription._callback_type is not Subscription.CallbackType.MessageOnly
                )
                arguments = (message, details) if wants_details else (message,)
                await await_or_execute(subscription.callback, *arguments)
            except Exception as error:
                self._drop(subscription, error)

        return work

    def _drop(self, subscription: Subscription, error: Exception) -> None:
        topic = str(subscription.topic_name)
        self.dropped[topic] += 1
        for node in self.get_nodes():
            node.get_logger().warning(
                f"{topic}: a message was dropped ({self.dropped[topic]} so far): {error}; "
                "check its publisher",
                throttle_duration_sec=WARNING_PERIOD,
            )


def _decoded(payload: bytes, kind: type[Any]) -> Any:
    try:
        return deserialize_message(payload, kind)
    except Exception as error:  # of no common base: rmw's own, or Unicode's
        raise DataError(f"it is not a valid {kind.__name__}") from error
