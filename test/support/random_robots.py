"""Random robots and random motions: branching trees, slides, oblique axes, any frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.frames import Frame
from symbid_ros.model.inertia import phi_from_pseudo_inertia
from symbid_ros.model.tree import Joint, Link, RobotModel

CONFIG = Path(__file__).resolve().parents[2] / "config"


def random_rotation(rng):
    matrix, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = matrix * np.sign(np.diag(upper))
    return matrix * np.sign(np.linalg.det(matrix))


def random_phi(rng):
    """Return φ of a cloud of point masses: consistent by construction."""
    points = rng.normal(size=(6, 3)) * rng.uniform(0.05, 0.2) + rng.normal(size=3) * 0.1
    homogeneous = np.c_[points, np.ones(6)]
    return phi_from_pseudo_inertia(homogeneous.T @ (homogeneous * rng.uniform(0.1, 1, (6, 1))))


def random_robot(seed, links=8, *, floating=True, wrench_frames=2):
    """Return a random tree; its IMU sits on any link, its wrench frames anywhere."""
    rng = np.random.default_rng(seed)
    joints = tuple(
        Joint(
            name=f"joint_{index}",
            kind="prismatic" if rng.random() < 0.25 else "revolute",
            parent=int(rng.integers(max(0, index - 3), index + 1)),
            rotation=random_rotation(rng),
            translation=rng.normal(size=3) * 0.2,
            axis=(axis := rng.normal(size=3)) / np.linalg.norm(axis),
            lower=-3.0,
            upper=3.0,
            effort=float(rng.choice([0.0, 50.0])),
        )
        for index in range(links - 1)
    )
    # Depth-first order of the links is what a file yields; reorder so that it holds.
    joints = _depth_first(joints)
    names = ["imu_link", *(f"wrench_{i}" for i in range(wrench_frames))]
    frames = tuple(
        Frame(
            name,
            int(rng.integers(0, links)) if floating or name != "imu_link" else 0,
            random_rotation(rng),
            rng.normal(size=3) * 0.1,
        )
        for name in names
    )
    bodies = tuple(Link(f"link_{index}", random_phi(rng)) for index in range(links))
    gravity = np.array([0.0, 0.0, -9.81])
    if not floating:
        gravity = random_rotation(rng) @ gravity
    return RobotModel(f"random_{seed}", bodies, joints, frames, floating, gravity, "random")


def with_drives(model, rng, *, damping=1.0, friction_loss=2.0, armature=0.5):
    """Return the robot with random joint terms up to these sizes."""
    joints = tuple(
        replace(
            joint,
            damping=damping * rng.uniform(0.1, 1),
            friction_loss=friction_loss * rng.uniform(0.1, 1),
            armature=armature * rng.uniform(0.1, 1),
        )
        for joint in model.joints
    )
    return replace(model, joints=joints)


def _depth_first(joints):
    children = {}
    for index, joint in enumerate(joints):
        children.setdefault(joint.parent, []).append(index)
    order, stack = [], children.get(0, [])[::-1]
    while stack:
        index = stack.pop()
        order.append(index)
        stack += children.get(index + 1, [])[::-1]
    new = {0: 0, **{old + 1: position + 1 for position, old in enumerate(order)}}
    return tuple(
        Joint(**{**joints[old].__dict__, "parent": new[joints[old].parent]}) for old in order
    )


def random_samples(model, count, rng, wrench_frames=None):
    """Return random states, accelerations, efforts and wrenches of a robot."""
    joints = len(model.joints)
    if wrench_frames is None:
        wrench_frames = tuple(f.name for f in model.frames if f.name.startswith("wrench"))
    base = rng.normal(size=(3, count, 3)) * np.array([1, 5, 10])[:, None, None]
    if not model.floating:
        base = np.zeros((3, count, 3))
        base[2] = -model.gravity
    return Samples(
        stamp=np.arange(count, dtype=np.int64) * 1_000_000,
        position=rng.uniform(-1, 1, (count, joints)),
        velocity=rng.normal(size=(count, joints)) * 2,
        acceleration=rng.normal(size=(count, joints)) * 10,
        effort=rng.normal(size=(count, joints)) * 20,
        base_angular_velocity=base[0],
        base_angular_acceleration=base[1],
        base_specific_force=base[2],
        wrenches=rng.normal(size=(count, len(wrench_frames), 6)) * 30,
        wrench_frames=wrench_frames,
    )
