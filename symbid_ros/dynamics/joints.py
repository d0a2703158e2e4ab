"""The joints of a robot side by side, so that a block of samples needs no object per joint."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.spatial import skew
from symbid_ros.model.tree import Joint


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
