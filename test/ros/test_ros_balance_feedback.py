"""Joint states and IMU data are paired by stamp and read by name."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
import rclpy
from junk_messages import some_malformed
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, JointState

from symbid_ros.errors import DataError
from symbid_ros.ros.balance_controller import MAX_UNPAIRED, FeedbackSubscriber
from symbid_ros.simulation.sensors import BalanceFeedback

JOINTS = ("hip", "knee")
MILLISECOND = 1_000_000
DEADLINE = 100.0  # s; only a missing pair takes longer


class Robot:
    """A robot's publishers and a controller's subscriber in one process."""

    def __init__(self, node: Node) -> None:
        self.joint_publisher = node.create_publisher(JointState, "joint_states", 1000)
        self.imu_publisher = node.create_publisher(Imu, "imu/data", 1000)
        self.subscriber = FeedbackSubscriber(node, JOINTS)
        while not (
            self.joint_publisher.get_subscription_count()
            and self.imu_publisher.get_subscription_count()
        ):
            pass

    def joints(self, *milliseconds: int, **changes: object) -> None:
        for each in milliseconds:
            message = JointState(
                name=["toe", "knee", "hip"],
                position=[0.0, 0.2 + each, 0.1 + each],
                velocity=[0.0, 2.0, 1.0],
            )
            for name, value in changes.items():
                setattr(message, name, value)
            self._publish(self.joint_publisher, message, each)

    def imu(self, *milliseconds: int, rate: float = 3.0) -> None:
        for each in milliseconds:
            message = Imu()
            message.orientation.x, message.orientation.w = 0.6, 0.8
            message.angular_velocity.z = rate
            self._publish(self.imu_publisher, message, each)

    @staticmethod
    def _publish(publisher, message, milliseconds: int) -> None:
        message.header.stamp.sec, rest = divmod(milliseconds, 1000)
        message.header.stamp.nanosec = rest * MILLISECOND
        publisher.publish(message)

    def read(self, milliseconds: int) -> BalanceFeedback:
        """Read until feedback arrives; its stamp must be the given one."""
        deadline = time.monotonic() + DEADLINE
        while (readings := self.subscriber.newest()) is None:
            assert time.monotonic() < deadline, "no instant has both joints and IMU"
            self.subscriber.wait(1.0)
        assert readings.stamp == milliseconds * MILLISECOND
        return readings


@pytest.fixture
def robot(domain: int) -> Iterator[Robot]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("robot", context=context)
    yield Robot(node)
    node.destroy_node()
    context.try_shutdown()


def test_joints_are_read_by_name_and_paired_with_the_imu(robot: Robot) -> None:
    robot.joints(5)
    robot.imu(5)
    readings = robot.read(5)
    np.testing.assert_array_equal(readings.joint_position, [5.1, 5.2])
    np.testing.assert_array_equal(readings.joint_velocity, [1.0, 2.0])
    np.testing.assert_array_equal(readings.imu_orientation, [0.6, 0.0, 0.0, 0.8])
    np.testing.assert_array_equal(readings.imu_angular_velocity, [0.0, 0.0, 3.0])
    assert robot.subscriber.newest() is None
    robot.joints(6, name=["hip", "toe", "knee"], position=[1.0, 2.0, 3.0])
    robot.imu(6)
    np.testing.assert_array_equal(robot.read(6).joint_position, [1.0, 3.0])


def test_a_wait_ends_with_the_message_that_was_missing(robot: Robot) -> None:
    for first, second in ((robot.joints, robot.imu), (robot.imu, robot.joints)):
        for stamp in range(1, 4):
            first(stamp)
            assert robot.subscriber.newest() is None
            second(stamp)
            robot.subscriber.wait(DEADLINE)
            robot.read(stamp)


def test_an_imu_at_half_the_rate_limits_the_complete_instants(robot: Robot) -> None:
    robot.joints(1, 2, 3, 4)
    robot.imu(1)
    robot.read(1)
    robot.imu(3)
    robot.read(3)
    robot.joints(5, 6)
    robot.imu(5)
    robot.read(5)
    assert robot.subscriber.skipped == 2


def test_the_newest_joint_states_are_kept_while_the_imu_is_silent(robot: Robot) -> None:
    waiting = 5 * MAX_UNPAIRED
    robot.joints(*range(1, waiting + 1))
    robot.imu(waiting)
    readings = robot.read(waiting)
    np.testing.assert_allclose(readings.joint_position, [waiting + 0.1, waiting + 0.2])
    assert robot.subscriber.skipped <= MAX_UNPAIRED  # the others had been dropped


def test_a_backward_clock_jump_clears_earlier_messages(robot: Robot) -> None:
    robot.joints(7000, 7001)
    robot.imu(7000)
    robot.read(7000)
    robot.joints(1)
    robot.imu(1)
    robot.read(1)
    robot.joints(2)
    robot.imu(7001, 2)
    robot.read(2)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"name": ["toe", "knee", "nose"]}, "no joint hip; publish it"),
        ({"velocity": []}, "positions and velocities differ"),
        ({"position": [0.0, float("nan"), 0.0]}, "NaN or infinite values at 0.003 s"),
        ({"velocity": [0.0, 1e4, 0.0]}, "rates above 1000 rad/s at 0.003 s"),
    ],
)
def test_an_invalid_message_raises_once_with_the_reason(robot: Robot, changes, says) -> None:
    robot.joints(3, **changes)
    robot.imu(3)
    with pytest.raises(DataError, match=says):
        robot.read(3)
    assert robot.subscriber.newest() is None
    robot.joints(4)
    robot.imu(4)
    robot.read(4)


def test_junk_on_the_topics_is_counted_and_displaces_nothing(robot: Robot) -> None:
    junk = some_malformed(serialize_message(JointState(name=["hip", "knee"])), 50)
    robot.joints(5)
    robot.joints(1, name=["wheel"])
    for payload in junk:
        robot.joint_publisher.publish(payload)
        robot.imu_publisher.publish(payload)
    robot.imu(5)
    read, refused, rejected = None, 0, 1 + 2 * len(junk)
    while read is None or robot.subscriber.rejected < rejected:
        try:
            robot.subscriber.wait(0.2)
            read = robot.subscriber.newest() or read
        except DataError:
            refused += 1
    assert read.stamp == 5 * MILLISECOND
    assert refused
    assert robot.subscriber.rejected == rejected
