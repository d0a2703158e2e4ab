"""A quadruped on four points that sways, turns and pushes itself about, with drives that rub."""

from pathlib import Path

import numpy as np
from analytic_log import imu_motion, waves
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from symbid_ros.bags import BagWriter
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.messages.types import (
    BOOL,
    IMU,
    JOINT_STATE,
    POSE,
    WRENCH,
    fill_message,
    fill_wrench,
    imu_layout,
    joint_state_layout,
    pose_layout,
    wrench_layout,
)
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

RATE = 250
FEET = ("LF_foot", "RF_foot", "LH_foot", "RH_foot")
LINK = """<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>
<inertia ixx="{ix}" iyy="{iy}" izz="{iz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at}"/><axis xyz="{axis}"/>
<limit lower="-2.6" upper="2.6" effort="80" velocity="20"/></joint>"""


def quadruped_urdf() -> str:
    """Return a robot of 40 kg with three joints and a bare point in each leg."""
    parts = [LINK.format(name="base", com="0.01 0 0.02", mass=24, ix=0.4, iy=0.9, iz=1.1)]
    parts.append('<link name="imu_link"/>')
    parts.append(
        '<joint name="imu" type="fixed"><parent link="base"/><child link="imu_link"/>'
        '<origin xyz="0.1 0 0.05" rpy="0 0 1.57"/></joint>'
    )
    for leg, x, y in (("LF", 1, 1), ("RF", 1, -1), ("LH", -1, 1), ("RH", -1, -1)):
        chain = [
            ("HAA", "base", f"{0.3 * x} {0.12 * y} 0", "1 0 0", "0.02 0.01 0", 1.5, 3e-3),
            ("HFE", f"{leg}_HAA_link", f"0.05 {0.08 * y} 0", "0 1 0", "0.01 0 -0.1", 1.9, 2e-2),
            ("KFE", f"{leg}_HFE_link", "0 0 -0.28", "0 1 0", "0 0 -0.12", 0.6, 5e-3),
        ]
        for name, on, at, axis, com, mass, inertia in chain:
            child = f"{leg}_{name}_link"
            parts.append(
                LINK.format(name=child, com=com, mass=mass, ix=inertia, iy=inertia, iz=inertia / 3)
            )
            parts.append(
                JOINT.format(
                    name=f"{leg}_{name}",
                    kind="revolute",
                    parent=on,
                    child=child,
                    at=at,
                    axis=axis,
                )
            )
        parts.append(f'<link name="{leg}_foot"/>')
        parts.append(
            f'<joint name="{leg}_fixed" type="fixed"><parent link="{leg}_KFE_link"/>'
            f'<child link="{leg}_foot"/><origin xyz="0 0 -0.28"/></joint>'
        )
    return f'<robot name="quadruped">{"".join(parts)}</robot>'


def load_quadruped(folder):
    """Return the robot, read from a file in a folder."""
    path = folder / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return load_model(path)


def inaccurate(true_robot):
    """Return the robot as a model file has it, with links that are off by up to 25 %."""
    parameters = ParameterSet(true_robot)
    return parameters.apply(draw_prior(parameters, "consistent", 25, 1).mean)


def standing_log(model, seconds, seed, friction=0.1, *, captured=False, steps=False, radius=0.0):
    """Return what its sensors read by topic: stamps (N,), s, and named columns.

    ``captured`` adds the base's pose and the wrench of each foot in world axes about the world's
    origin, as motion capture and force plates give them. With ``steps`` it lifts one foot after
    the other, and the topics ``/<foot>/contact`` tell which of them touch the ground. The ground
    pushes each foot ``radius``, m, below its frame.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    rotation = Rotation.from_rotvec(waves(rng, time, (3,), 0.3)[0]).as_matrix()
    place = waves(rng, time, (3,), 0.06)[0]
    closed, moved = _steps(time) if steps else (np.ones((len(time), len(FEET))), 0.0)
    position = _feet_at_rest(model, rotation, place, moved)
    rate, acceleration = _derivative(time, position, 1), _derivative(time, position, 2)
    spin = np.swapaxes(rotation, 1, 2) @ _derivative(time, rotation, 1)
    omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    felt = np.einsum("nji,nj->ni", rotation, _derivative(time, place, 2) - model.gravity)
    samples = Samples(
        stamp=np.arange(len(time)),
        position=position,
        velocity=rate,
        acceleration=acceleration,
        effort=np.zeros_like(position),
        base_angular_velocity=omega,
        base_angular_acceleration=_derivative(time, omega, 1),
        base_specific_force=felt,
        wrenches=np.zeros((len(time), len(FEET), 6)),
        wrench_frames=FEET,
    )
    parameters = ParameterSet(model)
    owed = equation_of_motion(parameters, samples).K @ parameters.values
    jacobian = contact_jacobian(model, FEET, link_poses(model, position))
    # Points carry no moment; the load wanders between the feet.
    share = closed * (1 + 0.6 * waves(rng, time, (len(FEET),), 1.0)[0])
    weight = np.kron(share, [1, 1, 1])
    of_force = _wrenches_of_forces(model, position, rotation, radius)
    reach = np.swapaxes(jacobian[:, :, :6], 1, 2) @ of_force
    response = (reach * weight[:, None]) @ np.swapaxes(reach, 1, 2)
    carried = np.linalg.solve(response, owed[:, :6, None])
    force = weight * np.einsum("nji,nj->ni", reach, carried[:, :, 0])
    wrench = np.einsum("nij,nj->ni", of_force, force)
    effort = owed[:, 6:] - np.einsum("nij,ni->nj", jacobian[:, :, 6:], wrench)
    load = friction * np.sqrt(np.mean(effort**2, axis=0))
    effort = effort + load * (np.tanh(rate / 0.02) + 0.3 * rate)
    imu = imu_motion(model, samples, "imu_link")
    mount = rotation @ model.frame("imu_link").rotation
    wrenches = wrench.reshape(len(time), len(FEET), 6)

    def noise(values, size):
        return values + size * rng.standard_normal(values.shape)

    log = {
        "/joint_states": {
            "time": time,
            "position": noise(position, 2e-5),
            "velocity": noise(rate, 5e-3),
            "effort": noise(effort, 0.1),
        },
        "/imu": {
            "time": time,
            "orientation": Rotation.from_matrix(mount).as_quat(),
            "angular_velocity": noise(imu.angular_velocity, 3e-3) + 0.01,
            "linear_acceleration": noise(imu.specific_force, 0.05),
        },
    }
    for index, foot in enumerate(FEET):
        force = noise(wrenches[:, index, 3:], 0.3)
        moment = noise(wrenches[:, index, :3], 0.01)
        log[f"/{foot}/wrench"] = {"time": time, "wrench": np.hstack([force, moment])}
        if steps:
            log[f"/{foot}/contact"] = {"time": time, "touches": closed[:, index] > 0}
    if captured:
        quaternion = Rotation.from_matrix(rotation).as_quat()
        pose = np.hstack([noise(place, 1e-4), noise(quaternion, 1e-4)])
        log["/base/pose"] = {"time": time, "pose": pose}
        poses = link_poses(model, position)
        for index, foot in enumerate(FEET):
            frame = model.frame(foot)
            turn = rotation @ poses.rotation[:, frame.link] @ frame.rotation
            force = np.einsum("nij,nj->ni", turn, wrenches[:, index, 3:])
            at = _feet(model, position, rotation, place)[:, index]
            world = np.hstack([noise(force, 0.3), noise(np.cross(at, force), 0.01)])
            log[f"/{foot}/plate"] = {"time": time, "wrench": world}
    return log


def record_log(log, model, path: Path) -> Path:
    """Write a log as a recorder would, its joints in another order than the model's."""
    order = np.random.default_rng(0).permutation(len(model.joint_names))
    messages = []
    with BagWriter(path) as writer:
        for topic in log:
            columns = {name: values for name, values in log[topic].items() if name != "time"}
            stamp = 10**18 + np.round(log[topic]["time"] * 1e9).astype(np.int64)
            if topic == "/joint_states":
                layout = joint_state_layout(tuple(model.joint_names[i] for i in order))
                records = layout.records(len(stamp))
                fill_message(records, stamp, **{k: v[:, order] for k, v in columns.items()})
                channel = writer.add_topic(topic, JOINT_STATE)
            elif topic.endswith("/contact"):
                # It has no stamp, and arrives after the joint state of the same instant.
                channel = writer.add_topic(topic, BOOL)
                messages += [
                    (int(when) + 1, channel, bytes([0, 1, 0, 0, flag]))
                    for when, flag in zip(stamp, columns["touches"].tolist(), strict=True)
                ]
                continue
            elif topic == "/imu":
                records = imu_layout("imu_link").records(len(stamp))
                fill_message(records, stamp, **columns)
                channel = writer.add_topic(topic, IMU)
            elif topic == "/base/pose":
                records = pose_layout("map").records(len(stamp))
                place, turn = columns["pose"][:, :3], columns["pose"][:, 3:]
                fill_message(records, stamp, **{"pose.position": place, "pose.orientation": turn})
                channel = writer.add_topic(topic, POSE)
            else:
                records = wrench_layout(topic.split("/")[1]).records(len(stamp))
                fill_wrench(records, stamp, **columns)
                channel = writer.add_topic(topic, WRENCH)
            messages += [
                (int(when), channel, record.tobytes())
                for when, record in zip(stamp, records, strict=True)
            ]
        for when, channel, payload in sorted(messages, key=lambda each: each[0]):
            writer.write(channel, when, payload)
    return path


def _wrenches_of_forces(model, position, rotation, radius):
    """Return (N, 24, 12): moment and force at each foot's frame of forces at points below it."""
    poses = link_poses(model, position)
    found = np.zeros((len(position), len(FEET), 6, len(FEET), 3))
    for index, foot in enumerate(FEET):
        frame = model.frame(foot)
        upward = (rotation @ poses.rotation[:, frame.link] @ frame.rotation)[:, 2]
        for axis, unit in enumerate(np.eye(3)):
            found[:, index, :3, index, axis] = np.cross(-radius * upward, unit)
            found[:, index, 3:, index, axis] = unit
    return found.reshape(len(position), 6 * len(FEET), 3 * len(FEET))


def _derivative(time, values, order):
    flat = values.reshape(len(time), -1)
    spline = make_interp_spline(time, flat, k=5).derivative(order)
    return spline(time).reshape(values.shape)


def _steps(time, period=2.4, lifted=0.4, ramp=0.1):
    """Return how firmly each foot stands (N, 4), from 0 to 1, and where it moved to (N, 4, 3)."""
    closed, moved = np.ones((len(time), len(FEET))), np.zeros((len(time), len(FEET), 3))
    for index in range(len(FEET)):
        after = (time - 0.5 * ramp - index * period / len(FEET)) % period
        down = np.clip(after / ramp, 0, 1)
        up = np.clip((after - ramp - lifted) / ramp, 0, 1)
        closed[:, index] = 1 - down**3 * (10 - 15 * down + 6 * down**2) * (after < ramp)
        closed[after >= ramp, index] = (up**3 * (10 - 15 * up + 6 * up**2))[after >= ramp]
        swing = np.clip((after - ramp) / lifted, 0, 1)
        bump = np.sin(np.pi * swing) ** 4
        moved[:, index] = bump[:, None] * np.array([0.05, 0.02, 0.08])
    return closed, moved


def _feet_at_rest(model, rotation, place, moved=0.0):
    """Return joint positions (N, 12) that leave the feet where they stood, by Newton's method.

    ``moved`` (N, 4, 3) displaces them.
    """
    bent = np.tile([0.0, 0.7, -1.4], 4)
    position = np.tile(bent, (len(place), 1))
    targets = _feet(model, bent[None], np.eye(3)[None], np.zeros((1, 3))) + moved
    for _ in range(8):
        off = targets - _feet(model, position, rotation, place)
        jacobian = contact_jacobian(model, FEET, link_poses(model, position))[:, :, 6:]
        poses = link_poses(model, position)
        for index, foot in enumerate(FEET):
            link = model.frame(foot).link
            own = slice(3 * index, 3 * index + 3)
            turn = rotation @ poses.rotation[:, link] @ model.frame(foot).rotation
            away = np.einsum("nji,nj->ni", turn, off[:, index])
            step = np.linalg.solve(jacobian[:, 6 * index + 3 : 6 * index + 6, own], away[..., None])
            position[:, own] += step[..., 0]
    return position


def _feet(model, position, rotation, place):
    poses = link_poses(model, position)
    feet = []
    for foot in FEET:
        frame = model.frame(foot)
        at_base = poses.position[:, frame.link] + poses.rotation[:, frame.link] @ frame.translation
        feet.append(place + np.einsum("nij,nj->ni", rotation, at_base))
    return np.stack(feet, axis=1)
