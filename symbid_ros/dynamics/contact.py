"""Contact forces predicted from the equation of motion (thesis, Eq. 4.1)."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, joint_axes
from symbid_ros.dynamics.wrenches import wrenches_at_base
from symbid_ros.model.tree import RobotModel

# Singular values of a contact Jacobian below this share of its largest count as zero.
RANK_TOLERANCE = 1e-10


def contact_jacobian(model: RobotModel, frames: Sequence[str], poses: LinkPoses) -> FloatArray:
    """Return the geometric Jacobian J_g (N, 6 F, n) of F frames, stacked.

    Parameters
    ----------
    model : RobotModel
        The robot.
    frames : sequence of str
        Wrench frames. Two may be on one link.
    poses : LinkPoses
        Link poses of N samples.

    Returns
    -------
    (N, 6 F, n) float64
        Six rows per frame, (angular; linear) in the frame's own axes at its origin. The columns
        are the six of a floating base's twist, in base axes, then one per joint, zero for a
        mimic joint. J_gᵀ f_e is the generalised force of wrenches f_e in the frames' axes (Eq. 4).
    """
    count = len(poses.position)
    first_joint = 6 * model.floating
    # The Jacobian's rows are the generalised forces of unit wrenches.
    names = [name for name in frames for _ in range(6)]
    units = np.broadcast_to(np.tile(np.eye(6), (len(frames), 1)), (count, len(names), 6))
    at_base = wrenches_at_base(model, units, names, poses)
    carries = model.ancestors[:, [model.loaded_link(name) for name in names]]
    jacobian = np.empty((count, len(names), model.dof))
    if model.floating:
        jacobian[:, :, :6] = at_base
    axes = joint_axes(model, poses)
    jacobian[:, :, first_joint:] = (at_base @ axes.transpose(0, 2, 1)) * carries.T
    model.fold_followers(jacobian.transpose(0, 2, 1))
    return jacobian


def contact_wrenches(
    jacobian: FloatArray, force: FloatArray, tolerance: float = RANK_TOLERANCE
) -> FloatArray:
    """Return the environment's wrenches f_e = (J_gᵀ)⁺ (K φ - Sᵀ f_a), Eq. 4.1.

    They minimise the norm of J_gᵀ f_e - (K φ - Sᵀ f_a), with equal weights for newtons and newton
    metres. Two feet and sixteen coordinates leave only four redundant equations, so the wrenches
    absorb most of an error in φ. These predictions cannot replace measured wrenches.

    Where J_gᵀ lacks full column rank, the data do not determine all of f_e, and the least squares
    solution of minimum norm is returned. Examples are:

    - more wrench components than coordinates (two feet and an overhead support),
    - a frame on a fixed base,
    - legs in one plane (no joint resists opposite moments of the feet),
    - several frames on one link (only the sum of their wrenches matters).

    Parameters
    ----------
    jacobian : (N, 6 F, n) float64
        Jacobian from :func:`contact_jacobian`.
    force : (N, ..., n) float64
        K φ - Sᵀ f_a, the generalised force that the motors do not supply, Nm and N. Several
        forces per sample share the pseudoinverse.
    tolerance : float
        Singular values below this share of the largest are treated as zero.

    Returns
    -------
    (N, ..., F, 6) float64
        Per frame (moment; force) on the robot, in the frame's own axes about its origin.
    """
    inverse = np.linalg.pinv(jacobian.transpose(0, 2, 1), tolerance)
    stacked: FloatArray = np.einsum("nij,n...j->n...i", inverse, force)
    return stacked.reshape(*force.shape[:-1], jacobian.shape[1] // 6, 6)
