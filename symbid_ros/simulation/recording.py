"""Topics of the simulated robot, and their recording into a bag."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from dataclasses import replace as with_fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.bags import BagWriter, create_folder
from symbid_ros.messages import types as messages
from symbid_ros.messages.layout import Columns, Layout
from symbid_ros.simulation.scenario import SUPPORT_FRAME
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import WrenchSensor
from symbid_ros.simulation.systematic_errors import SampleRates

logger = logging.getLogger(__name__)

WORLD = "world"
SLOWEST = 0.01  # rad/s or m/s; what slower joints carry is not judged
BLOCK = 500  # instants encoded together: large enough to be efficient, small enough for progress

# Message fields and the attributes of `Instant` that fill them.
JOINTS = {"position": "joint_position", "velocity": "joint_velocity", "effort": "joint_effort"}
IMU = {
    "orientation": "imu_orientation",
    "angular_velocity": "imu_angular_velocity",
    "linear_acceleration": "imu_linear_acceleration",
}
TRUE_JOINTS = {
    "points.0.positions": "true_position",
    "points.0.velocities": "true_velocity",
    "points.0.accelerations": "true_acceleration",
    "points.0.effort": "true_effort",
}
ODOMETRY = {
    "pose.pose.position": "base_position",
    "pose.pose.orientation": "base_orientation",
    "twist.twist.linear": "base_linear_velocity",
    "twist.twist.angular": "base_angular_velocity",
}
BASE_ACCELERATION = {
    "accel.linear": "base_linear_acceleration",
    "accel.angular": "base_angular_acceleration",
}


class SimulatedRobot(Protocol):
    """A simulated robot with sensors, see :class:`symbid_ros.simulation.simulator.Simulator`.

    ``imu_frame`` is empty for a robot without an IMU.
    """

    joint_names: tuple[str, ...]
    base_frame: str
    imu_frame: str
    wrench_sensors: tuple[WrenchSensor, ...]
    sample_rates: SampleRates
    period_ns: int
    steps: int

    def step(self) -> Instant:
        """Simulate one period and return the instant at its start."""
        ...


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


def sensor_topics(robot: SimulatedRobot) -> tuple[SimulatedTopic, ...]:
    """Return the topics of joint states, IMU and wrenches."""
    rates = robot.sample_rates
    joint_states = messages.joint_state_layout(robot.joint_names)
    imus = []
    if robot.imu_frame:
        layout = messages.imu_layout(robot.imu_frame)
        imus = [SimulatedTopic("imu/data", layout, _fill(IMU), rates.imu)]
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
        SimulatedTopic("joint_states", joint_states, _fill(JOINTS), rates.joints),
        *imus,
        *wrenches,
    )


def truth_topics(robot: SimulatedRobot) -> tuple[SimulatedTopic, ...]:
    """Return the topics of the true motion, for validation only."""
    joints = messages.trajectory_layout(robot.joint_names)
    odometry = messages.odometry_layout(WORLD, robot.base_frame)
    acceleration = messages.accel_layout(robot.base_frame)
    return (
        SimulatedTopic("ground_truth/joints", joints, _fill(TRUE_JOINTS)),
        SimulatedTopic("ground_truth/odom", odometry, _fill(ODOMETRY)),
        SimulatedTopic("ground_truth/base_accel", acceleration, _fill(BASE_ACCELERATION)),
    )


def _fill(attributes: Mapping[str, str]) -> Fill:
    def fill(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
        values = {field: getattr(instant, name) for field, name in attributes.items()}
        messages.fill_message(columns, stamp, **values)

    return fill


def _wrench_fill(index: int) -> Fill:
    def fill(columns: Columns, stamp: IntArray | int, instant: Instant) -> None:
        messages.fill_wrench(columns, stamp, instant.wrenches[..., index, :])

    return fill


def _report_noise(out: Path, names: Sequence[str], squares: FloatArray) -> None:
    """Log the moving joints whose noise exceeds their efforts.

    ``squares`` (3, J) are mean squares of efforts, their noise and velocities.
    """
    of_effort, of_noise, speed = np.sqrt(squares)
    noisy = np.flatnonzero((of_noise > of_effort) & (of_effort > 0) & (speed > SLOWEST))
    if len(noisy):
        ratio = of_noise[noisy] / of_effort[noisy]
        logger.warning(
            "%s: the noise of efforts exceeds the efforts: %s; give a smaller `effort_noise`",
            out,
            ", ".join(
                f"{names[index]} {one:.2g} times"
                for index, one in zip(noisy.tolist(), ratio.tolist(), strict=True)
            ),
        )


def record(
    simulator: SimulatedRobot,
    out: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    replace: bool = False,
) -> dict[str, int]:
    """Simulate the motion and write its sensor and ground-truth topics to a bag.

    The log time of a message is its stamp, so equal seeds give equal message payloads. Moving
    joints whose noise exceeds their efforts are logged.

    Parameters
    ----------
    simulator : SimulatedRobot
        A simulator that has not been stepped.
    out : Path
        Folder of the bag; it appears when the bag is complete.
    progress : callable, optional
        Called with the number of written instants and the total number.
    replace : bool
        Whether the bag replaces an earlier one; otherwise ``out`` must not exist.

    Returns
    -------
    dict of str to int
        Number of messages by topic.
    """
    topics = [*sensor_topics(simulator), *truth_topics(simulator)]
    with create_folder(out, replace=replace) as folder, BagWriter(folder) as bag:
        channels = [bag.add_topic(f"/{topic.name}", topic.layout.msgtype) for topic in topics]
        done, squares = 0, np.zeros((3, len(simulator.joint_names)))
        while done < simulator.steps:
            instants = [simulator.step() for _ in range(min(BLOCK, simulator.steps - done))]
            stamps = np.array([instant.stamp for instant in instants])
            arrays: dict[str, Any] = {
                field.name: np.stack([getattr(instant, field.name) for instant in instants])
                for field in fields(Instant)
                if field.name != "stamp"
            }
            block = with_fields(instants[0], **arrays)
            noise = block.joint_effort - block.true_effort
            signals = block.true_effort, noise, block.true_velocity
            squares += [np.sum(each**2, axis=0) for each in signals]
            payloads = []
            for topic in topics:
                records = topic.layout.records(len(instants))
                topic.fill(topic.layout.columns(records), stamps, block)
                payloads.append(records)
            for row, instant in enumerate(instants):
                for channel, topic, records in zip(channels, topics, payloads, strict=True):
                    if (done + row) % topic.every == 0:
                        bag.write(channel, instant.stamp, records[row].tobytes())
            done += len(instants)
            if progress is not None:
                progress(done, simulator.steps)
    _report_noise(out, simulator.joint_names, squares / max(simulator.steps, 1))
    return bag.counts
