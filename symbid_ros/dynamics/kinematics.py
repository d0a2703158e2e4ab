"""Forward kinematics of a block of samples, with no world in it.

The base's specific force already holds gravity, so positions, velocities and the
gravity direction in the world never appear (Featherstone 2008, §5.3, for trees). All
vectors are in base axes: there each link's motion is the base's plus a sum over the joints
on the way to it, and only the rotations are left to chain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.spatial import component_first, cross, matvec, sample_first, skew
from symbid_ros.model.tree import Joint, RobotModel


@dataclass(frozen=True)
class JointTable:
    """Constants of J joints that carry the links 1 to J; L = J + 1.

    Attributes
    ----------
    parent : (J,) int64
        Parent links.
    turns : (J, 1) float64
        1 for a revolute joint, 0 for a prismatic one.
    slides : (J,) int64
        Indices of the prismatic joints.
    axis : (3, J) float64
        Unit vectors in the child's axes.
    reference : (J, 1) float64
        Positions at which the child stands as the model file says.
    pose : (J, 15, 4) float64
        Child's rotation, translation and joint axis, flattened from (3, 5), in the parent:
        ``pose @ [1, sin q, cos q, q]`` with q counted from the reference.
    path : (L, J) float64
        1 where a joint lies between the base and a link, Eq. 10's δ_j(l).
    """

    parent: IntArray
    turns: FloatArray
    slides: IntArray
    axis: FloatArray
    reference: FloatArray
    pose: FloatArray
    path: FloatArray

    @classmethod
    def of(cls, joints: Sequence[Joint]) -> "JointTable":
        """Line up joints, parents before children."""
        count = len(joints)
        path = np.zeros((count + 1, count))
        for index, joint in enumerate(joints):
            path[index + 1] = path[joint.parent]
            path[index + 1, index] = 1.0
        turns = np.array([joint.kind == "revolute" for joint in joints], dtype=np.float64)
        return cls(
            parent=np.array([joint.parent for joint in joints], dtype=np.int64),
            turns=turns[:, None],
            slides=np.flatnonzero(turns == 0),
            axis=np.array([joint.axis for joint in joints]).reshape(count, 3).T,
            reference=np.array([joint.reference for joint in joints]).reshape(count, 1),
            pose=_pose_terms(joints, turns),
            path=path,
        )

    def __len__(self) -> int:
        return len(self.parent)

    def poses(self, position: FloatArray) -> FloatArray:
        """Return rotation | translation | axis (J, 3, 5, N) in the parents at positions (J, N)."""
        displacement = position - self.reference
        basis = np.empty((len(self), 4, position.shape[1]))
        basis[:, 0], basis[:, 3] = 1.0, displacement
        np.sin(displacement, out=basis[:, 1])
        np.cos(displacement, out=basis[:, 2])
        return (self.pose @ basis).reshape(len(self), 3, 5, position.shape[1])

    def along_path(self, base: FloatArray, step: FloatArray) -> FloatArray:
        """Return vectors (3, L, N): the base's (3, N) plus the steps (3, J, N) on the way."""
        total: FloatArray = self.path @ step
        total += base[:, None]
        return total


def _pose_terms(joints: Sequence[Joint], turns: FloatArray) -> FloatArray:
    """Return the (J, 15, 4) factors of 1, sin q, cos q and q in the poses (Rodrigues)."""
    count = len(joints)
    rotation = np.array([joint.rotation for joint in joints]).reshape(count, 3, 3)
    axis = np.array([joint.axis for joint in joints]).reshape(count, 3)
    turns = turns[:, None, None]
    # What a prismatic joint leaves alone is all of the rotation, not the axis's part of it.
    kept = np.where(turns, axis[:, :, None] * axis[:, None], np.eye(3))
    terms = np.zeros((count, 3, 5, 4))
    terms[:, :, :3, 0] = rotation @ kept
    terms[:, :, :3, 1] = rotation @ (skew(axis.T).transpose(2, 0, 1) * turns)
    terms[:, :, :3, 2] = rotation @ (np.eye(3) - kept)
    terms[:, :, 3, 0] = np.array([joint.translation for joint in joints]).reshape(count, 3)
    terms[:, :, 4, 0] = (rotation @ axis[:, :, None])[..., 0]
    terms[:, :, 3, 3] = terms[:, :, 4, 0] * (1 - turns[..., 0])
    return terms.reshape(count, 15, 4)


@dataclass(frozen=True)
class LinkPoses:
    """Poses of L links relative to the base, for N samples.

    The arrays of :func:`link_poses` are views whose memory runs along the samples.

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
class Posture:
    """Links and joints of N samples in base axes, component first.

    Attributes
    ----------
    joints : JointTable
        The J joints.
    pose : (3, 4, L, N) float64
        Rotations from link axes to base axes, then the link origins in m.
    axis : (3, J, N) float64
        Unit vectors of the joints.
    lever : (3, J, N) float64
        From the parent's origin to the child's, m.
    """

    joints: JointTable
    pose: FloatArray
    axis: FloatArray
    lever: FloatArray

    @classmethod
    def at(cls, joints: JointTable, position: FloatArray) -> "Posture":
        """Place the links at joint positions (J, N)."""
        count = position.shape[1]
        placed = np.empty((3, 5, len(joints) + 1, count))
        placed[:, :, 0] = np.eye(3, 5)[..., None]
        for child, (parent, pose) in enumerate(
            zip(joints.parent.tolist(), joints.poses(position), strict=True), start=1
        ):
            np.einsum("ikn,kjn->ijn", placed[:, :3, parent], pose, out=placed[:, :, child])
        pose, axis = placed[:, :4], placed[:, 4, 1:]
        # So far the last column holds levers; their sum along the path is the origin.
        lever = pose[:, 3, 1:].copy()
        pose[:, 3] = joints.along_path(np.zeros((3, count)), lever)
        return cls(joints, pose, axis, lever)

    @classmethod
    def of(cls, joints: JointTable, poses: LinkPoses) -> "Posture":
        """Take the links as placed by :func:`link_poses`."""
        rotation, origin = component_first(poses.rotation), component_first(poses.position)
        pose = np.concatenate([rotation, origin[:, None]], axis=1)
        axis = np.einsum("ikjn,kj->ijn", rotation[:, :, 1:], joints.axis)
        return cls(joints, pose, axis, origin[:, 1:] - origin[:, joints.parent])

    @property
    def rotation(self) -> FloatArray:
        """(3, 3, L, N) rotations from link axes to base axes."""
        return self.pose[:, :3]

    @property
    def position(self) -> FloatArray:
        """(3, L, N) link origins, m."""
        return self.pose[:, 3]

    @property
    def poses(self) -> LinkPoses:
        """The links' poses, sample first."""
        return LinkPoses(sample_first(self.rotation), sample_first(self.position))

    @property
    def motion_axes(self) -> FloatArray:
        """(6, J, N) joint axes about the base's origin, angular part first."""
        slides = self.joints.slides
        axes = np.concatenate([self.axis, cross(self.position[:, 1:], self.axis)])
        axes[:3, slides], axes[3:, slides] = 0.0, self.axis[:, slides]
        return axes


@dataclass(frozen=True)
class LinkMotion:
    """Motion of L links for N samples, component first, in base axes.

    Attributes
    ----------
    angular_velocity, angular_acceleration : (3, L, N) float64
        ω in rad/s and ω̇ in rad/s².
    specific_force : (3, L, N) float64
        Acceleration of the link's origin minus gravity, m/s².
    lever_acceleration : (3, 3, L, N) float64
        S(ω̇) + S(ω)², which takes a vector fixed to the link to its second derivative.
    """

    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    lever_acceleration: FloatArray


def link_poses(model: RobotModel, position: FloatArray) -> LinkPoses:
    """Return the poses of all links at joint positions (N, J)."""
    return Posture.at(JointTable.of(model.joints), component_first(position)).poses


def joint_axes(model: RobotModel, poses: LinkPoses) -> FloatArray:
    """Return the motion axes (N, J, 6) of the joints, in base axes about the base's origin.

    Angular part first: the base-frame columns of the geometric Jacobian.
    """
    return sample_first(Posture.of(JointTable.of(model.joints), poses).motion_axes)


def link_motion(
    posture: Posture,
    velocity: FloatArray,
    acceleration: FloatArray,
    base: tuple[FloatArray, FloatArray, FloatArray],
) -> LinkMotion:
    """Propagate the base's ω, ω̇ and specific force, (3, N), outwards at joint rates (J, N)."""
    joints, axis = posture.joints, posture.axis
    spin = axis * (velocity * joints.turns)
    omega = joints.along_path(base[0], spin)
    w = omega[:, joints.parent]
    change = axis * (acceleration * joints.turns)
    change += cross(w, spin)
    alpha = joints.along_path(base[1], change)
    lever_acceleration = _lever_acceleration(omega, alpha)
    step = matvec(lever_acceleration[:, :, joints.parent], posture.lever)
    for j in joints.slides:
        slide = axis[:, j]
        step[:, j] += slide * acceleration[j] + 2 * cross(w[:, j], slide * velocity[j])
    force = joints.along_path(base[2], step)
    return LinkMotion(omega, alpha, force, lever_acceleration)


def _lever_acceleration(omega: FloatArray, alpha: FloatArray) -> FloatArray:
    """Return S(ω̇) + S(ω)² (3, 3, ...) with S(ω)² = ωωᵀ - |ω|² 1."""
    matrix = omega[:, None] * omega
    square = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    for i in range(3):
        matrix[i, i] -= square
    matrix += skew(alpha)
    return matrix


def link_velocity(
    posture: Posture, velocity: FloatArray, base_angular: FloatArray, base_linear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return angular and linear velocities (3, L, N) of the link origins, in base axes.

    The base's own are (3, N), the joints' (J, N).
    """
    joints, axis = posture.joints, posture.axis
    omega = joints.along_path(base_angular, axis * (velocity * joints.turns))
    step = cross(omega[:, joints.parent], posture.lever)
    for j in joints.slides:
        step[:, j] += axis[:, j] * velocity[j]
    return omega, joints.along_path(base_linear, step)
