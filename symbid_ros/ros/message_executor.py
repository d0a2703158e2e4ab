"""An executor that no message can end."""

from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.subscription import Subscription

WARNING_PERIOD = 5.0  # s between two warnings

Work = Callable[[], Coroutine[Any, Any, None]]


class MessageExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """Drops and counts the messages that cannot be taken or that their callback cannot use.

    rclpy lets such an exception end the thread that spins: a negative time on ``/clock`` ends
    every node that follows it. Exceptions of timers and services still end the node.

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
            work: Work | None = super()._take_subscription(subscription)
        except Exception as error:
            self._drop(subscription, error)
            return None
        if work is None:
            return None

        async def guarded() -> None:
            try:
                await work()
            except Exception as error:
                self._drop(subscription, error)

        return guarded

    def _drop(self, subscription: Subscription, error: Exception) -> None:
        topic = str(subscription.topic_name)
        self.dropped[topic] += 1
        for node in self.get_nodes():
            node.get_logger().warning(
                f"{topic}: a message was dropped ({self.dropped[topic]} so far): {error}; "
                "check its publisher",
                throttle_duration_sec=WARNING_PERIOD,
            )
