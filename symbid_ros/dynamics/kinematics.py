"""Forward kinematics of a block of samples, with no world in it.

The base's specific force already holds gravity, so positions, velocities and the
gravity direction in the world never appear (Featherstone 2008, §5.3, for trees).
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import axis_rotations, cross, rotate, rotate_back
from symbid_ros.model.tree import Joint, RobotModel


@dataclass(frozen=True)
class LinkPoses:
    """Poses of L links relative to the base, for N samples.

    Attributes
    ----------
    rotation : (N, L, 3, 3) float64
        From link axes to base axes.
    position : (N, L, 3) float64
        Link origins in the base frame, m.
    """

    rotation: FloatArray
    position: FloatArray


@dataclass(frozen=True)
class LinkMotion:
    """Motion of L links for N samples, each in its own link's axes.

    Attributes
    ----------
    poses : LinkPoses
        Where the links are.
    angular_velocity, angular_acceleration : (N, L, 3) float64
        rad/s and rad/s².
    specific_force : (N, L, 3) float64
        Acceleration of the link's origin minus gravity, m/s².
    """

    poses: LinkPoses
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray


def joint_pose(joint: Joint, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation (N, 3, 3) and translation (N, 3) of the child in the parent.

    ``position`` (N,) is the joint's position, rad or m.
    """
    displacement = position - joint.reference
    if joint.kind == "revolute":
        rotation = joint.rotation @ axis_rotations(joint.axis, displacement)
        return rotation, np.broadcast_to(joint.translation, (len(position), 3))
    shift = displacement[:, None] * (joint.rotation @ joint.axis)
    return np.broadcast_to(joint.rotation, (len(position), 3, 3)), joint.translation + shift


def link_poses(model: RobotModel, position: FloatArray) -> LinkPoses:
    """Return the poses of all links at joint positions (N, J)."""
    return _chained(model, joint_poses(model, position), len(position))


def joint_poses(model: RobotModel, position: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return :func:`joint_pose` of every joint at joint positions (N, J)."""
    return [joint_pose(joint, position[:, index]) for index, joint in enumerate(model.joints)]


def _chained(
    model: RobotModel, transforms: list[tuple[FloatArray, FloatArray]], count: int
) -> LinkPoses:
    rotation = np.empty((count, len(model.links), 3, 3))
    origin = np.empty((count, len(model.links), 3))
    rotation[:, 0], origin[:, 0] = np.eye(3), 0.0
    for index, (joint, (turn, shift)) in enumerate(zip(model.joints, transforms, strict=True)):
        rotation[:, index + 1] = rotation[:, joint.parent] @ turn
        origin[:, index + 1] = origin[:, joint.parent] + rotate(rotation[:, joint.parent], shift)
    return LinkPoses(rotation, origin)


def link_motion(model: RobotModel, samples: Samples) -> LinkMotion:
    """Propagate the base's motion outwards to every link."""
    shape = (len(samples), len(model.links), 3)
    omega, alpha, force = np.empty(shape), np.empty(shape), np.empty(shape)
    omega[:, 0] = samples.base_angular_velocity
    alpha[:, 0] = samples.base_angular_acceleration
    force[:, 0] = samples.base_specific_force
    transforms = joint_poses(model, samples.position)
    for index, (joint, (turn, shift)) in enumerate(zip(model.joints, transforms, strict=True)):
        parent, child = joint.parent, index + 1
        rate = samples.velocity[:, index, None] * joint.axis
        change = samples.acceleration[:, index, None] * joint.axis
        w, a = omega[:, parent], alpha[:, parent]
        at_child = force[:, parent] + cross(a, shift) + cross(w, cross(w, shift))
        omega[:, child] = w = rotate_back(turn, w)
        alpha[:, child] = rotate_back(turn, a)
        force[:, child] = rotate_back(turn, at_child)
        if joint.kind == "revolute":
            alpha[:, child] += change + cross(w, rate)
            omega[:, child] += rate
        else:
            force[:, child] += change + 2 * cross(w, rate)
    poses = _chained(model, transforms, len(samples))
    return LinkMotion(poses, omega, alpha, force)


def joint_axes(model: RobotModel, poses: LinkPoses) -> FloatArray:
    """Return the motion axes (N, J, 6) of the joints, in base axes about the base's origin.

    Angular part first: the base-frame columns of the geometric Jacobian.
    """
    axes = np.zeros((len(poses.rotation), len(model.joints), 6))
    for index, joint in enumerate(model.joints):
        direction = rotate(poses.rotation[:, index + 1], joint.axis)
        if joint.kind == "revolute":
            axes[:, index, :3] = direction
            axes[:, index, 3:] = cross(poses.position[:, index + 1], direction)
        else:
            axes[:, index, 3:] = direction
    return axes
