"""An arm with a payload behind a wrist sensor: forces by MuJoCo's inverse dynamics and sensors."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import mujoco
import numpy as np
from analytic_log import waves
from random_logs import write_bag
from scipy.spatial.transform import Rotation

from symbid_ros.messages.types import (
    ACCEL,
    ODOMETRY,
    TRAJECTORY,
    accel_layout,
    fill_stamp,
    odometry_layout,
    trajectory_layout,
)
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.signals.streams import JointStream, Streams, WrenchStream

MASS, COM, INERTIA = 1.7, np.array([0.03, -0.02, 0.08]), np.diag([0.009, 0.011, 0.006])
# Force, then torque.
OFFSET = np.array([4.0, -7.0, 12.0, 0.3, -0.2, 0.5])


@dataclass(frozen=True)
class ArmLog:
    """Arrays of an arm's sensors; ``wrench`` (N, 6) is force, then torque of the payload."""

    time: np.ndarray
    position: np.ndarray
    effort: np.ndarray
    wrench: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def payload_arm_log(arm, frame, *, seconds=20.0, rate=250.0, seed=0, noise=1.0, size=1.2):
    """Return what an arm and a sensor at one of its frames measure while it moves a payload.

    ``noise`` is a multiple of a good sensor's: .1 Nm, .3 N and .01 Nm, 2e-5 rad.
    """
    mount = arm.frame(frame)
    root = ET.fromstring(mjcf_text(arm))
    name = arm.link_names[mount.link]
    (body,) = (one for one in root.iter("body") if one.get("name") == name)
    quaternion = np.roll(Rotation.from_matrix(mount.rotation).as_quat(), 1)
    load = ET.SubElement(
        body, "body", name="load", pos=_text(mount.translation), quat=_text(quaternion)
    )
    ET.SubElement(
        load, "inertial", mass=str(MASS), pos=_text(COM), diaginertia=_text(np.diag(INERTIA))
    )
    ET.SubElement(load, "site", name="sensor")
    sensors = ET.SubElement(root, "sensor")
    ET.SubElement(sensors, "force", site="sensor")
    ET.SubElement(sensors, "torque", site="sensor")
    m = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    d = mujoco.MjData(m)
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    motion = waves(rng, time, (len(arm.joints),), size)
    effort, wrench = np.empty_like(motion[0]), np.empty((len(time), 6))
    for index, state in enumerate(zip(*motion, strict=True)):
        d.qpos[:], d.qvel[:], d.qacc[:] = state
        mujoco.mj_inverse(m, d)
        effort[index] = d.qfrc_inverse
        # MuJoCo's sensors read the force of the arm on the payload.
        wrench[index] = -d.sensordata
    # MuJoCo's inverse dynamics include damping, but no dry friction.
    effort += np.array([one.friction_loss for one in arm.joints]) * np.sign(motion[1])
    effort += noise * 0.1 * rng.normal(size=effort.shape)
    wrench += noise * np.repeat([0.3, 0.01], 3) * rng.normal(size=wrench.shape)
    position = motion[0] + noise * 2e-5 * rng.normal(size=effort.shape)
    return ArmLog(time, position, effort, wrench + OFFSET, *motion[1:])


def _text(values):
    return " ".join(repr(float(one)) for one in values)


def write_payload_bag(log, arm, frame, path, *, truth=False):
    """Write the log as a bag, its wrench on a topic of its own, perhaps with the ground truth."""
    stamp = np.rint(log.time * 1e9).astype(np.int64)
    topics = _truth_topics(log, arm, stamp) if truth else []
    joints = JointStream(
        "/joint_states",
        arm.joint_names,
        stamp,
        log.position,
        np.full_like(log.position, np.nan),
        log.effort,
    )
    wrench = WrenchStream("/wrist/wrench", frame, stamp, log.wrench[:, :3], log.wrench[:, 3:])
    return write_bag(Streams("arm", joints, (), (wrench,)), path, topics)


def _truth_topics(log, arm, stamp):
    """Return the simulator's topics of the true motion of an arm whose base is at rest."""
    joints = trajectory_layout(arm.joint_names).records(len(stamp))
    fill_stamp(joints, stamp)
    for field, values in (
        ("positions", log.position),
        ("velocities", log.velocity),
        ("accelerations", log.acceleration),
        ("effort", log.effort),
    ):
        joints[f"points.0.{field}"][...] = values
    base = odometry_layout("world", "base_link").records(len(stamp))
    fill_stamp(base, stamp)
    base["pose.pose.orientation"][...] = [0, 0, 0, 1]
    rest = accel_layout("base_link").records(len(stamp))
    fill_stamp(rest, stamp)
    return [
        ("/ground_truth/joints", TRAJECTORY, stamp, joints),
        ("/ground_truth/odom", ODOMETRY, stamp, base),
        ("/ground_truth/base_accel", ACCEL, stamp, rest),
    ]
