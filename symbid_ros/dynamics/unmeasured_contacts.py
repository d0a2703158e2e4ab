"""Rows of the equation of motion that no unmeasured contact wrench enters.

Without wrench sensors the contact wrenches f_e are unknown at every instant. The rows
N(q) K φ = N(q) Sᵀ f_a with N(q) J_gᵀ(q) = 0 remain, which no contact wrench enters. They need the
efforts of all joints that act on them.

N = d(q) E P(q), where P projects onto the orthogonal complement of the range of J_gᵀ, and E selects
as many coordinates as rows are left. Averages over windows need an N that is smooth in time, and P
is not smooth where J_g loses rank. The factor d = det(J Jᵀ) / det(J Jᵀ + ε²) vanishes there, and
det(J Jᵀ) P = det(J Jᵀ) - Jᵀ adj(J Jᵀ) J is a polynomial of J. E depends on the robot alone, so that
logs can be merged. Units may be mixed: other units give other combinations of the same rows, and
rows are weighted by the covariance of their residuals.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import qr

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.contact import RANK_TOLERANCE, contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import Contacts, RobotModel

# Factor below which a row is no part of a combination.
NEGLIGIBLE = 1e-12
POINT, SURFACE = "point", "surface"
# ε over the largest singular value of J_g. Directions of J_g below this share are damped: the
# weaker they are, the faster the directions without contact wrenches rotate, so that encoder noise
# would dominate. Opposite moments on feet with legs in parallel planes have a share below 1e-3.
DAMPING = 3e-4
# Postures from which the coordinates are selected, and the largest angle in them, rad.
POSTURES, LARGEST_ANGLE = 100, 1.0
ENDS = "lower", "upper"  # of a joint's range
# By how much rows of the base are preferred to those of joints.
PREFERENCE = 10.0


def with_contacts(model: RobotModel, contacts: Sequence[str]) -> RobotModel:
    """Return a robot with unmeasured wrenches at some frames.

    Parameters
    ----------
    model : RobotModel
        The robot.
    contacts : sequence of str
        ``FRAME`` or ``FRAME:surface`` for a contact with force and moment, ``FRAME:point`` for one
        with a force alone.

    Raises
    ------
    ModelError
        When a frame is unknown, or the wrenches explain any motion.
    """
    if not contacts:
        return model
    frames: list[str] = []
    possible: list[int] = []
    for index, contact in enumerate(contacts):
        frame, _, kind = contact.partition(":")
        frames.append(model.frame(frame).name)
        first = 3 if kind == POINT else 0
        possible += range(6 * index + first, 6 * index + 6)
    postures = _postures(model)
    J = contact_jacobian(model, frames, link_poses(model, postures))
    generic = J[0][np.array(possible)]
    _, R, order = qr(generic.T, mode="economic", pivoting=True)
    size = np.abs(R.diagonal())
    rank = int(np.sum(size > RANK_TOLERANCE * size.max(initial=0.0)))
    left = model.dof - len(model.followers) - rank
    if left <= 0:
        raise ModelError(
            f"{model.source}: unknown wrenches at {', '.join(frames)} explain any motion of this "
            "robot; name fewer frames in `contact`, mark points as FRAME:point, or record wrenches",
            "E121",
        )
    components = np.array(possible)[np.sort(order[:rank])]
    damping = DAMPING * float(np.linalg.norm(J[:, components], 2, axis=(1, 2)).max())
    projections = annihilator(J[:, components], damping, np.eye(model.dof)).mean(axis=0)
    projections[:, : 6 * model.floating] *= PREFERENCE
    projections[:, [6 * model.floating + joint for joint in model.followers]] = 0.0
    _, _, order = qr(projections, mode="economic", pivoting=True)
    chosen = np.sort(order[:left]).astype(np.int64)
    return replace(
        model, contacts=Contacts(tuple(contacts), tuple(frames), components, damping, chosen)
    )


def _postures(model: RobotModel) -> FloatArray:
    """Return postures (N, J) near the middle of the joints' ranges, the same in every call."""
    rng = np.random.default_rng(0)
    lower, upper = (np.array([getattr(one, end) for one in model.joints]) for end in ENDS)
    is_limited = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(is_limited, np.where(is_limited, lower + upper, 0.0) / 2, 0.0)
    half = np.minimum(np.where(is_limited, upper - middle, LARGEST_ANGLE), LARGEST_ANGLE)
    share = rng.uniform(-1, 1, (POSTURES, len(model.joints)))
    return model.apply_mimics(middle + share * half)


def annihilator(jacobian: FloatArray, damping: float, selection: FloatArray) -> FloatArray:
    """Return N = d E P (N, k, n) for a Jacobian J (N, r, n) and a selection E (k, n)."""
    rank = jacobian.shape[1]
    Q, R = np.linalg.qr(jacobian.transpose(0, 2, 1), mode="complete")
    determinant = np.prod(np.diagonal(R, axis1=1, axis2=2) ** 2, axis=1)
    damped = np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1) + damping**2 * np.eye(rank))
    free = Q[:, :, rank:]
    N: FloatArray = (selection @ free) @ free.transpose(0, 2, 1)
    N *= (determinant / damped)[:, None, None]
    return N


def without_contacts(
    model: RobotModel, position: FloatArray, *columns: FloatArray
) -> list[FloatArray]:
    """Return rows (N, n, c) at joint positions (N, J) combined so that no contact enters them.

    The rows of other coordinates than ``model.contacts.coordinates`` are zero. NaN in a row is also
    in the combinations that contain it.
    """
    contacts = model.contacts
    assert contacts is not None
    poses = link_poses(model, position)
    J = contact_jacobian(model, contacts.frames, poses)[:, contacts.components]
    N = annihilator(J, contacts.damping, np.eye(model.dof)[contacts.coordinates])
    combined = []
    for rows in columns:
        is_known = np.isfinite(rows)
        kept = N @ np.where(is_known, rows, 0.0)
        if not is_known.all():
            kept[(np.abs(N) > NEGLIGIBLE).astype(float) @ ~is_known > 0] = np.nan
        result = np.zeros_like(rows)
        result[:, contacts.coordinates] = kept
        combined.append(result)
    return combined
