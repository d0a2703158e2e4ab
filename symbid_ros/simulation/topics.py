"""Topics of the simulated robot and their messages, for bags and publishers."""

from collections.abc import Callable
from dataclasses import dataclass

from symbid_ros.arrays import IntArray
from symbid_ros.messages import types as messages
from symbid_ros.messages.layout import Columns, Layout
from symbid_ros.simulation.scenario import SUPPORT_FRAME
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator

WORLD = "world"

Fill = Callable[[Columns, IntArray | int, Instant], None]


@dataclass(frozen=True)
class SimulatedTopic:
    """One topic of the simulated robot.

    Attributes
    ----------
    name : str
        Relative topic name.
    layout : Layout
        Layout of its messages.
    fill : callable
        ``fill(columns, stamp, instant)`` writes one instant into the columns of one record, or N
        instants into N records when stamp is (N,) and the instant's arrays have a leading axis
        of N.
    every : int
        Instants from one message to the next, starting at the first instant.
    """

    name: str
    layout: Layout
    fill: Fill
    every: int = 1


def sensor_topics(robot: Simulator) -> tuple[SimulatedTopic, ...]:
    """Return the topics of joint states, IMU and wrenches."""
    rates = robot.sample_rates
    wrenches = [
        SimulatedTopic(
            sensor.topic,
            messages.wrench_layout(sensor.frame_id),
            _wrench_fill(index),
            1 if sensor.frame_id == SUPPORT_FRAME else rates.plates,
        )
        for index, sensor in enumerate(robot.wrench_sensors)
    ]
    return (
        SimulatedTopic(
            "joint_states",
            messages.joint_state_layout(robot.joint_names),
            _fill_joints,
            rates.joints,
        ),
        SimulatedTopic("imu/data", messages.imu_layout(robot.imu_frame), _fill_imu, rates.imu),
        *wrenches,
    )


def truth_topics(robot: Simulator) -> tuple[SimulatedTopic, ...]:
    """Return the topics of the true motion, for validation only."""
    return (
        SimulatedTopic(
            "ground_truth/joints", messages.trajectory_layout(robot.joint_names), _fill_true_joints
        ),
        SimulatedTopic(
            "ground_truth/odom", messages.odometry_layout(WORLD, robot.base_frame), _fill_odometry
        ),
        SimulatedTopic(
            "ground_truth/base_accel", messages.accel_layout(robot.base_frame), _fill_accel
        ),
    )


def _fill_joints(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
    messages.fill_message(
        columns,
        stamp,
        position=instant.joint_position,
        velocity=instant.joint_velocity,
        effort=instant.joint_effort,
    )


def _fill_imu(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
    messages.fill_message(
        columns,
        stamp,
        orientation=instant.imu_orientation,
        angular_velocity=instant.imu_angular_velocity,
        linear_acceleration=instant.imu_linear_acceleration,
    )


def _wrench_fill(index: int) -> Fill:
    def fill(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
        messages.fill_wrench(columns, stamp, instant.wrenches[..., index, :])

    return fill


def _fill_true_joints(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
    fields = {
        "points.0.positions": instant.true_position,
        "points.0.velocities": instant.true_velocity,
        "points.0.accelerations": instant.true_acceleration,
        "points.0.effort": instant.true_effort,
    }
    messages.fill_message(columns, stamp, **fields)


def _fill_odometry(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
    fields = {
        "pose.pose.position": instant.base_position,
        "pose.pose.orientation": instant.base_orientation,
        "twist.twist.linear": instant.base_linear_velocity,
        "twist.twist.angular": instant.base_angular_velocity,
    }
    messages.fill_message(columns, stamp, **fields)


def _fill_accel(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
    fields = {
        "accel.linear": instant.base_linear_acceleration,
        "accel.angular": instant.base_angular_acceleration,
    }
    messages.fill_message(columns, stamp, **fields)
