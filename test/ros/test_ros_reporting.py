"""Python's loggers on a node's console and on /rosout."""

import logging
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from symbid_ros.ros.reporting import forward_python_logs

MARK = "the last of these messages"
DEADLINE = 120.0  # s; only a hang takes longer


@pytest.fixture
def logged(domain: int) -> Iterator[tuple[Node, Callable[[], list[Log]]]]:
    """Return a node and a function that returns its messages on /rosout before a final one."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("subject", context=context, namespace="/robot1")
    found: list[Log] = []
    latched = QoSProfile(depth=1000, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Log, "/rosout", found.append, latched)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def messages() -> list[Log]:
        node.get_logger().fatal(MARK)
        deadline = time.monotonic() + DEADLINE
        while not (found and found[-1].msg == MARK):
            assert time.monotonic() < deadline, found
            executor.spin_once(timeout_sec=0.05)
        return found[:-1]

    yield node, messages
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


def test_python_loggers_log_under_the_nodes_name_with_their_severity(logged) -> None:
    node, messages = logged
    with forward_python_logs(node):
        logging.getLogger("symbid_ros.bags").warning("%d messages are out of order", 3)
        logging.getLogger("symbid_ros.online.identification").error("the block is lost")
        logging.getLogger("a_library").warning("deprecated")
        logging.getLogger("symbid_ros.model").info("loaded")
        logging.getLogger("symbid_ros.model").debug("below the node's level")
    logging.getLogger("symbid_ros.bags").warning("of nobody's")
    found = [(one.level, one.name, one.msg) for one in messages()]
    assert found == [
        (Log.WARN, "robot1.subject", "3 messages are out of order"),
        (Log.ERROR, "robot1.subject", "the block is lost"),
        (Log.WARN, "robot1.subject", "deprecated"),
        (Log.INFO, "robot1.subject", "loaded"),
    ]


def test_the_nodes_level_filters_at_run_time(logged) -> None:
    node, messages = logged
    logger = logging.getLogger("symbid_ros.model")
    with forward_python_logs(node):
        node.get_logger().set_level(LoggingSeverity.DEBUG)
        logger.debug("in detail")
        node.get_logger().set_level(LoggingSeverity.ERROR)
        logger.warning("not wanted")
    node.get_logger().set_level(LoggingSeverity.INFO)
    assert [one.msg for one in messages()] == ["in detail"]


def test_repeated_messages_are_suppressed_for_a_minute_despite_other_numbers(logged) -> None:
    node, messages = logged
    child, other = (logging.getLogger(f"symbid_ros.{name}") for name in ("bags.child", "online"))
    with forward_python_logs(node):
        for count in range(5):
            child.warning("%s: %d of %d messages are late", "/robot1/imu", count, 1000 + count)
            child.warning("%s: %d of %d messages are late", "/robot2/imu", count, 1000 + count)
            other.warning("silent from %.3f s to %.3f s", count * 4.0, count * 4.0 + 4.0)
    assert [one.msg for one in messages()] == [
        "/robot1/imu: 0 of 1000 messages are late",
        "/robot2/imu: 0 of 1000 messages are late",
        "silent from 0.000 s to 4.000 s",
    ]
