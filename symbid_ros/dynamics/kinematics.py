"""Forward kinematics of a block of samples, relative to the base.

The base's specific force contains gravity, so the world's axes, positions and velocities are not
needed (Featherstone 2008, §5.3, for trees). All vectors are in base axes: each link's motion is
the base's plus a sum over the joints between them, and only rotations are chained.

The functions of this subpackage accept and return arrays with the sample axis first, (N, L, 3).
Inside, arrays are *component first*, (3, L, N), because NumPy is much faster along contiguous
samples than on stacks of small matrices.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.model.tree import Joint, RobotModel

# Links times samples in one block: large enough to outweigh the cost of NumPy calls, small enough
# for temporary arrays to fit the cache.
CACHE_BLOCK = 3200


def cache_blocks(count: int, links: int) -> Iterator[slice]:
    """Yield slices of ``count`` samples, each small enough for the cache."""
    size = max(1, CACHE_BLOCK // links)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def component_first(x: FloatArray) -> FloatArray:
    """Return (N, L, ...) as (..., L, N), contiguous; vectors become (3, L, N).

    A copy is needed because NumPy's results inherit the memory layout of their operands.
    """
    return np.ascontiguousarray(x.transpose(*range(2, x.ndim), 1, 0))


def sample_first(x: FloatArray) -> FloatArray:
    """Return (..., L, N) as a view (N, L, ...), the inverse of :func:`component_first`."""
    return x.transpose(x.ndim - 1, x.ndim - 2, *range(x.ndim - 2))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b of component-first vectors (3, ...), with broadcasting."""
    a, b = a[[1, 2, 0, 1]], b[[1, 2, 0, 1]]
    product: FloatArray = a[:3] * b[1:]
    product -= a[1:] * b[:3]
    return product


def skew(x: FloatArray) -> FloatArray:
    """Return S(x) (3, 3, ...) of vectors (3, ...), S(x) y = x × y (Eq. 12)."""
    matrix = np.zeros((3, *x.shape))
    matrix[[2, 0, 1], [1, 2, 0]] = x
    matrix[[1, 2, 0], [2, 0, 1]] = -x
    return matrix


def matvec(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the products of component-first matrices (3, 3, ...) and vectors (3, ...)."""
    product: FloatArray = np.einsum("ij...,j...->i...", rotation, vector)
    return product


def rotate(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return rotation (..., 3, 3) applied to vectors (..., 3), with broadcasting."""
    rotated: FloatArray = np.einsum("...ij,...j->...i", rotation, vector)
    return rotated


def rotate_inverse(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the transposed rotation (..., 3, 3) applied to vectors (..., 3)."""
    rotated: FloatArray = np.einsum("...ji,...j->...i", rotation, vector)
    return rotated


@dataclass(frozen=True)
class JointTable:
    """Constants of J joints in arrays; joint j carries link j + 1 and L = J + 1.

    Attributes
    ----------
    parent : (J,) int64
        Parent links.
    revolute : (J, 1) float64
        1 for a revolute joint, 0 for a prismatic one.
    prismatic : (J,) int64
        Indices of the prismatic joints.
    axis : (3, J) float64
        Unit vectors in the child's axes.
    reference : (J, 1) float64
        Positions at which the child has the pose of the model file.
    pose : (J, 15, 4) float64
        Factors of the child's rotation, translation and joint axis in the parent, flattened from
        (3, 5): ``pose @ [1, sin q, cos q, q]`` with q measured from the reference.
    path : (L, J) float64
        1 where a joint lies between the base and a link, δ_j(l) of Eq. 10.
    """

    parent: IntArray
    revolute: FloatArray
    prismatic: IntArray
    axis: FloatArray
    reference: FloatArray
    pose: FloatArray
    path: FloatArray

    @classmethod
    def of(cls, joints: Sequence[Joint]) -> "JointTable":
        """Return the table of joints listed parents before children."""
        count = len(joints)
        path = np.zeros((count + 1, count))
        for index, joint in enumerate(joints):
            path[index + 1] = path[joint.parent]
            path[index + 1, index] = 1.0
        is_revolute = np.array([joint.kind == "revolute" for joint in joints], dtype=np.float64)
        return cls(
            parent=np.array([joint.parent for joint in joints], dtype=np.int64),
            revolute=is_revolute[:, None],
            prismatic=np.flatnonzero(is_revolute == 0),
            axis=np.array([joint.axis for joint in joints]).reshape(count, 3).T,
            reference=np.array([joint.reference for joint in joints]).reshape(count, 1),
            pose=_pose_terms(joints, is_revolute),
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
        """Return (3, L, N): the base's vector (3, N) plus the steps (3, J, N) along each path."""
        total: FloatArray = self.path @ step
        total += base[:, None]
        return total


def _pose_terms(joints: Sequence[Joint], is_revolute: FloatArray) -> FloatArray:
    """Return the (J, 15, 4) factors of 1, sin q, cos q and q in the poses (Rodrigues)."""
    count = len(joints)
    rotation = np.array([joint.rotation for joint in joints]).reshape(count, 3, 3)
    axis = np.array([joint.axis for joint in joints]).reshape(count, 3)
    is_revolute = is_revolute[:, None, None]
    # A prismatic joint keeps the whole rotation, a revolute joint only its axis's part.
    kept = np.where(is_revolute, axis[:, :, None] * axis[:, None], np.eye(3))
    terms = np.zeros((count, 3, 5, 4))
    terms[:, :, :3, 0] = rotation @ kept
    terms[:, :, :3, 1] = rotation @ (skew(axis.T).transpose(2, 0, 1) * is_revolute)
    terms[:, :, :3, 2] = rotation @ (np.eye(3) - kept)
    terms[:, :, 3, 0] = np.array([joint.translation for joint in joints]).reshape(count, 3)
    terms[:, :, 4, 0] = (rotation @ axis[:, :, None])[..., 0]
    terms[:, :, 3, 3] = terms[:, :, 4, 0] * (1 - is_revolute[..., 0])
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
        Unit vectors of the joint axes.
    lever : (3, J, N) float64
        Vectors from the parent's origin to the child's, m.
    """

    joints: JointTable
    pose: FloatArray
    axis: FloatArray
    lever: FloatArray

    @classmethod
    def at(cls, joints: JointTable, position: FloatArray) -> "Posture":
        """Return the posture at joint positions (J, N)."""
        count = position.shape[1]
        placed = np.empty((3, 5, len(joints) + 1, count))
        placed[:, :, 0] = np.eye(3, 5)[..., None]
        for child, (parent, pose) in enumerate(
            zip(joints.parent.tolist(), joints.poses(position), strict=True), start=1
        ):
            np.einsum("ikn,kjn->ijn", placed[:, :3, parent], pose, out=placed[:, :, child])
        pose, axis = placed[:, :4], placed[:, 4, 1:]
        # The origin is the sum of the levers, which fill the last column so far.
        lever = pose[:, 3, 1:].copy()
        pose[:, 3] = joints.along_path(np.zeros((3, count)), lever)
        return cls(joints, pose, axis, lever)

    @classmethod
    def of(cls, joints: JointTable, poses: LinkPoses) -> "Posture":
        """Return the posture of the poses of :func:`link_poses`."""
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
        slides = self.joints.prismatic
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
        S(ω̇) + S(ω)², which maps a vector fixed to the link to its second derivative.
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
    """Return link motion from the base's ω, ω̇ and specific force (3, N) and joint rates (J, N)."""
    joints, axis = posture.joints, posture.axis
    spin = axis * (velocity * joints.revolute)
    omega = joints.along_path(base[0], spin)
    w = omega[:, joints.parent]
    change = axis * (acceleration * joints.revolute)
    change += cross(w, spin)
    alpha = joints.along_path(base[1], change)
    lever_acceleration = _lever_acceleration(omega, alpha)
    step = matvec(lever_acceleration[:, :, joints.parent], posture.lever)
    for j in joints.prismatic:
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

    Base velocities are (3, N), joint velocities (J, N).
    """
    joints, axis = posture.joints, posture.axis
    omega = joints.along_path(base_angular, axis * (velocity * joints.revolute))
    step = cross(omega[:, joints.parent], posture.lever)
    for j in joints.prismatic:
        step[:, j] += axis[:, j] * velocity[j]
    return omega, joints.along_path(base_linear, step)
