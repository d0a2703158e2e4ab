"""Publishers wait for their subscribers for a limited time."""

from collections.abc import Iterator
from contextlib import suppress
from threading import Event

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from std_msgs.msg import String

from symbid_ros.ros import endpoints

KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


@pytest.fixture
def node(domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("publisher", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_a_stop_ends_the_wait_for_a_subscriber_that_takes_nothing(
    node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.create_subscription(String, "full", lambda message: None, KEEP_ALL)
    publisher = node.create_publisher(String, "full", KEEP_ALL)
    while not publisher.get_subscription_count():
        pass
    with suppress(RuntimeError):  # the queue is full
        while True:
            publisher.publish(String(data="more"))
    monkeypatch.setattr(endpoints, "ACKNOWLEDGE", float("inf"))
    stop = Event()
    stop.set()
    endpoints.await_acknowledgement([publisher], stop)
