"""Random logs of random robots: any length, rate, gaps, start and missing channels."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from analytic_log import analytic_samples, imu_motion
from random_robots import random_robot

from symbid_ros.bags import BagWriter
from symbid_ros.messages.layout import Layout, typestore
from symbid_ros.messages.types import (
    IMU,
    JOINT_STATE,
    WRENCH,
    fill_message,
    fill_stamp,
    fill_wrench,
    imu_layout,
    wrench_layout,
)
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

SECOND = 1_000_000_000
Topic = tuple[str, str, np.ndarray, np.ndarray]
FAULTS = (
    "no imu",
    "no wrench",
    "no effort",
    "no velocity",
    "effort nan",
    "joint nan",
    "zero effort",
    "joint missing",
    "positions in degrees",
)


@dataclass(frozen=True)
class LogPlan:
    """What a log looks like.

    Attributes
    ----------
    rate : float
        Of the joint states, Hz.
    count : int
        Joint states before gaps are cut out.
    start : int
        First stamp, ns.
    gaps : tuple of (float, float)
        Where a gap begins, as a share of the log, and how many periods it lasts.
    ratios : tuple of float
        Rate of IMU and wrench sensors over that of the joint states.
    jitter : float
        Of the stamps, as a share of a period.
    noise : float
        Of all channels, as a multiple of a good sensor's.
    fault : str
        One of `FAULTS`, or empty.
    """

    rate: float
    count: int
    start: int = 0
    gaps: tuple[tuple[float, float], ...] = ()
    ratios: tuple[float, float] = (1.0, 1.0)
    jitter: float = 0.0
    noise: float = 1.0
    fault: str = ""


def small_robot(seed: int, *, floating: bool, links: int = 3) -> RobotModel:
    """Return a random robot whose joints are all driven."""
    robot = random_robot(seed, links, floating=floating, wrench_frames=1 + seed % 2)
    return replace(robot, joints=tuple(replace(joint, effort=50.0) for joint in robot.joints))


def random_streams(model: RobotModel, plan: LogPlan, seed: int) -> Streams:
    """Return what noisy sensors say of a random motion of the model."""
    rng = np.random.default_rng(seed)
    parameters = ParameterSet(model)
    imu_ratio, wrench_ratio = plan.ratios

    def ticks(ratio: float, offset: float) -> np.ndarray:
        period = SECOND / plan.rate
        count = max(round(plan.count * ratio), 0)
        share = np.arange(count) / ratio + offset
        share = share + plan.jitter * rng.uniform(-0.5, 0.5, count)
        stamp = np.rint(share * period).astype(np.int64)
        for place, length in plan.gaps:
            begin = place * plan.count * period
            stamp = stamp[(stamp < begin) | (stamp >= begin + length * period)]
        return np.unique(stamp)

    def motion(stamp: np.ndarray):
        return analytic_samples(parameters, stamp, seed)

    def noisy(values: np.ndarray, deviation: float) -> np.ndarray:
        return values + plan.noise * deviation * rng.standard_normal(values.shape)

    joint_ticks = ticks(1.0, 0.0)
    imu_ticks = ticks(imu_ratio, 0.3 if imu_ratio != 1 else 0.0)
    wrench_ticks = ticks(wrench_ratio, 0.6 if wrench_ratio != 1 else 0.0)
    at_joints, at_imu, at_wrench = motion(joint_ticks), motion(imu_ticks), motion(wrench_ticks)
    joints = JointStream(
        "/joint_states",
        model.joint_names,
        plan.start + joint_ticks,
        noisy(at_joints.position, 2e-5),
        noisy(at_joints.velocity, 5e-3),
        noisy(at_joints.effort, 0.1),
    )
    imus: tuple[ImuStream, ...] = ()
    if model.floating:
        felt = imu_motion(model, at_imu, "imu_link")
        imus = (
            ImuStream(
                "/imu/data",
                "imu_link",
                plan.start + imu_ticks,
                None,
                noisy(felt.angular_velocity, 3e-3),
                noisy(felt.specific_force, 0.05),
            ),
        )
    wrenches = tuple(
        WrenchStream(
            f"/{frame}/wrench",
            frame,
            plan.start + wrench_ticks,
            noisy(at_wrench.wrenches[:, index, 3:], 0.3),
            noisy(at_wrench.wrenches[:, index, :3], 0.01),
        )
        for index, frame in enumerate(at_wrench.wrench_frames)
    )
    return _spoilt(Streams("random log", joints, imus, wrenches), plan.fault)


def _spoilt(streams: Streams, fault: str) -> Streams:
    """Return the streams with a fault that drivers have."""
    joints = streams.joints
    nan = np.full_like(joints.effort, np.nan)
    first = np.arange(len(joints.names)) == 0
    if fault == "no imu":
        return replace(streams, imus=())
    if fault == "no wrench":
        return replace(streams, wrenches=())
    if fault == "joint missing":
        fields = ("position", "velocity", "effort")
        kept = {name: getattr(joints, name)[:, 1:] for name in fields}
        return replace(streams, joints=replace(joints, names=joints.names[1:], **kept))
    changes = {
        "no effort": {"effort": nan},
        "effort nan": {"effort": np.where(first, nan, joints.effort)},
        "joint nan": {"position": np.where(first, nan, joints.position)},
        "zero effort": {"effort": np.zeros_like(nan)},
        "no velocity": {"velocity": nan},
        "positions in degrees": {"position": np.degrees(joints.position)},
    }
    return replace(streams, joints=replace(joints, **changes.get(fault, {})))


def write_bag(streams: Streams, path: Path, further: Sequence[Topic] = ()) -> Path:
    """Write streams as a recorder would; a joint array that is all NaN is left empty.

    ``further`` topics are (name, type, stamps, records).
    """
    joints = streams.joints
    given = {name: getattr(joints, name) for name in ("position", "velocity", "effort")}
    given = {name: values for name, values in given.items() if not np.isnan(values).all()}
    records = joint_layout(joints.names, given).records(len(joints.stamp))
    fill_stamp(records, joints.stamp)
    for name, values in given.items():
        records[name][...] = values
    topics = [*further, (joints.topic, JOINT_STATE, joints.stamp, records)]
    for imu in streams.imus:
        records = imu_layout(imu.frame_id).records(len(imu.stamp))
        upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(imu.stamp), 1))
        fill_message(
            records,
            imu.stamp,
            orientation=upright,
            angular_velocity=imu.angular_velocity,
            linear_acceleration=imu.linear_acceleration,
        )
        topics.append((imu.topic, IMU, imu.stamp, records))
    for one in streams.wrenches:
        records = wrench_layout(one.frame_id).records(len(one.stamp))
        fill_wrench(records, one.stamp, np.hstack([one.force, one.torque]))
        topics.append((one.topic, WRENCH, one.stamp, records))
    with BagWriter(path) as writer:
        messages = []
        for topic, msgtype, stamps, records in topics:
            channel = writer.add_topic(topic, msgtype)
            messages += [
                (int(stamp), channel, record.tobytes())
                for stamp, record in zip(stamps, records, strict=True)
            ]
        for stamp, channel, payload in sorted(messages, key=lambda each: each[:2]):
            writer.write(channel, max(stamp, 0), payload)
    return path


def joint_layout(names: tuple[str, ...], given: Collection[str]) -> Layout:
    """Return the layout of joint states in which only the given arrays are filled."""
    types = typestore().types
    time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    arrays = {
        name: np.zeros(len(names) if name in given else 0)
        for name in ("position", "velocity", "effort")
    }
    message = types[JOINT_STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=""), name=list(names), **arrays
    )
    return Layout.of(message, JOINT_STATE)
