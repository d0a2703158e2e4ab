"""Rows of the equation of motion that no unmeasured contact wrench enters.

Without wrench sensors the contact wrenches f_e are unknown at every instant. The rows
N(q) K φ = N(q) Sᵀ f_a with N(q) J_gᵀ(q) = 0 remain, which no contact wrench enters. They need the
efforts of all joints that act on them.

N = d(q) (E P Eᵀ)^(-1/2) E P(q), where P projects onto the orthogonal complement of the range of
J_gᵀ, and E selects as many coordinates as rows are left. The rows of N are orthonormal but for d.
Errors of equal size in all coordinates, such as those of drives, then have equal sizes in all rows
and postures, and a row that a posture makes small does not count for more. Averages over windows
need an N that is smooth in time, and P is not smooth where J_g loses rank. The factor
d = det(J Jᵀ) / det(J Jᵀ + ε²) vanishes there, and det(J Jᵀ) P = det(J Jᵀ) - Jᵀ adj(J Jᵀ) J is a
polynomial of J. E depends on the robot alone, so that logs can be merged.

A contact without moments acts at a point. That of a ball, such as the foot of a quadruped, is its
lowest point, which moves along the ball as the leg turns. The ground is taken to be level, and
:func:`symbid_ros.dynamics.upright.upward` finds what is above.

If it is known which contacts touch something, the others are left out of J_g. More rows remain
then: those of a leg that swings are used as they are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.linalg import qr

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.contact import RANK_TOLERANCE, contact_jacobian
from symbid_ros.dynamics.kinematics import LinkPoses, link_poses, skew
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.upright import upward
from symbid_ros.errors import ModelError
from symbid_ros.model.frames import ball_around
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
# Largest number of contacts of which some may touch nothing: there are 2^C combinations.
MOST_FLAGGED = 6
# Norm below which the projection of a coordinate adds no direction to those of others.
LEAST_SIZE = 1e-3
# By how much rows of the base are preferred to those of joints.
PREFERENCE = 10.0


def with_contacts(model: RobotModel, contacts: Sequence[str]) -> RobotModel:
    """Return a robot with unmeasured wrenches at some frames.

    Parameters
    ----------
    model : RobotModel
        The robot.
    contacts : sequence of str
        ``FRAME`` or ``FRAME:surface`` for a contact with force and moment, ``FRAME:RADIUS`` for one
        with a force alone at the bottom of a ball about the frame's origin, m, and ``FRAME:point``
        for one at the bottom of the ball of the model that contains the frame's origin, or else at
        that origin.

    Raises
    ------
    ModelError
        When a frame is unknown, or the wrenches explain any motion.
    """
    if not contacts:
        return model
    explicit = tuple(_explicit(model, one) for one in contacts)
    frames = tuple(model.frame(one.partition(":")[0]).name for one in explicit)
    found = _eliminated(model, explicit, frames)
    if not len(found.coordinates):
        raise ModelError(
            f"{model.source}: unknown wrenches at {', '.join(frames)} explain any motion of this "
            "robot; name fewer frames in `contact`, mark points as FRAME:point, or record wrenches",
            "E121",
        )
    return replace(model, contacts=found)


def contact_radius(model: RobotModel, contact: str) -> float | None:
    """Return the radius of the ball that touches something; 0 for a point, None for a surface.

    ``contact`` is as in :func:`with_contacts`.
    """
    return _radius(_explicit(model, contact))


def _explicit(model: RobotModel, contact: str) -> str:
    """Return a contact with the radius of the model's ball in place of ``point``."""
    name, _, kind = contact.partition(":")
    ball = ball_around(model.frame(name, "contact"), model.frames)
    return f"{ball.name}:{ball.radius:.6g}" if kind == POINT and ball else contact


def touched_frame(model: RobotModel, name: str) -> str:
    """Return the frame of the contact to which a contact flag or wrench of a frame belongs.

    It is the ball of a contact if that contains the named frame, otherwise the named frame itself.
    """
    touching = () if model.contacts is None else model.contacts.frames
    known = next((one for one in model.frames if one.name == name), None)
    if name in touching or known is None:
        return name
    ball = ball_around(known, model.frames)
    return ball.name if ball is not None and ball.name in touching else name


def _radius(name: str) -> float | None:
    """Return the radius of a contact without moments; None for a surface."""
    kind = name.partition(":")[2]
    if kind in ("", SURFACE):
        return None
    return 0.0 if kind == POINT else float(kind)


def with_all_rows(model: RobotModel) -> RobotModel:
    """Return a robot whose rows without contact wrenches are those of every coordinate.

    They are d P τ instead of d E P τ: dependent rows, but that of a joint is the part of its effort
    that no contact wrench can balance, for comparisons of predicted with measured efforts.
    """
    if model.contacts is None:
        return model
    coordinates = _own_coordinates(model)
    independent = model.contacts.independent or model.contacts
    found = replace(independent, coordinates=coordinates, independent=independent, by_state={})
    return replace(model, contacts=found)


def contacts_of_state(model: RobotModel, touching: tuple[bool, ...]) -> Contacts:
    """Return the contacts of a robot of which only some touch anything."""
    contacts = model.contacts
    assert contacts is not None
    if all(touching):
        return contacts
    if touching not in contacts.by_state:
        names, frames = (
            tuple(name for name, touches in zip(each, touching, strict=True) if touches)
            for each in (contacts.names, contacts.frames)
        )
        found = _eliminated(model, names, frames, contacts.coordinates)
        if contacts.has_all_rows:
            found = replace(found, coordinates=contacts.coordinates, independent=found)
        contacts.by_state[touching] = found
    return contacts.by_state[touching]


def _eliminated(
    model: RobotModel,
    names: tuple[str, ...],
    frames: tuple[str, ...],
    kept: IntArray | None = None,
) -> Contacts:
    """Return the contacts at some frames.

    Coordinates ``kept`` are among those whose rows remain, so that the rows of a coordinate have
    the same meaning, as far as possible, whichever frames touch something.
    """
    first, own = 6 * model.floating, _own_coordinates(model)
    loads = np.zeros((len(frames), model.dof), dtype=bool)
    loads[:, :first] = True
    loads[:, first:] = model.ancestors[:, [model.frame(name).link for name in frames]].T
    loads[:, [first + joint for joint in model.followers]] = False
    possible: list[int] = []
    for index, name in enumerate(names):
        start = 0 if _radius(name) is None else 3
        possible += range(6 * index + start, 6 * index + 6)
    radii = np.array([_radius(name) or 0.0 for name in names])
    if not possible:
        return Contacts(names, frames, radii, np.zeros(0, dtype=np.int64), 0.0, own, loads)
    J = contact_jacobian(model, frames, link_poses(model, _postures(model)))
    _, R, order = qr(J[0][np.array(possible)].T, mode="economic", pivoting=True)
    size = np.abs(R.diagonal())
    rank = int(np.sum(size > RANK_TOLERANCE * size.max(initial=0.0)))
    left = max(model.dof - len(model.followers) - rank, 0)
    components = np.array(possible)[np.sort(order[:rank])]
    damping = DAMPING * float(np.linalg.norm(J[:, components], 2, axis=(1, 2)).max())
    is_free = ~np.asarray(loads.any(axis=0))
    projections = annihilator(J[:, components], damping, np.eye(model.dof))
    projections[..., :first] *= PREFERENCE
    projections[..., [first + joint for joint in model.followers]] = 0.0
    free = own[is_free[own]]
    before = np.zeros(0, dtype=np.int64) if kept is None else np.setdiff1d(kept, free)
    others = np.setdiff1d(np.arange(model.dof), [*free, *before])
    chosen = _independent(projections, (free, before, others), left)
    return Contacts(names, frames, radii, components, damping, chosen, loads)


def _own_coordinates(model: RobotModel) -> IntArray:
    """Return the coordinates of the base and of joints that do not follow others."""
    followers = 6 * model.floating + np.array(sorted(model.followers), dtype=np.int64)
    own: IntArray = np.setdiff1d(np.arange(model.dof), followers)
    return own


def _independent(projections: FloatArray, groups: Sequence[IntArray], count: int) -> IntArray:
    """Return the coordinates whose rows remain, at most ``count``, sorted.

    Columns of the projections (N, n, n) of postures that are combinations of chosen ones, in each
    posture others, are left out. Coordinates of the first groups come first.
    """
    chosen: list[int] = []
    left = projections.copy()
    for group in groups:
        while len(chosen) < count:
            sizes = np.linalg.norm(left[..., group], axis=1)
            mean = sizes.mean(axis=0)
            if mean.max(initial=0.0) <= LEAST_SIZE:
                break
            best = int(np.argmax(mean))
            chosen.append(int(group[best]))
            axis = left[..., group[best], None] / np.maximum(sizes[:, best, None, None], NEGLIGIBLE)
            left -= axis @ (axis.swapaxes(1, 2) @ left)
    found: IntArray = np.sort(np.array(chosen, dtype=np.int64))
    return found


def _postures(model: RobotModel) -> FloatArray:
    """Return postures (N, J) near the middle of the joints' ranges, the same in every call."""
    rng = np.random.default_rng(0)
    lower, upper = (np.array([getattr(one, end) for one in model.joints]) for end in ENDS)
    is_limited = np.isfinite(lower) & np.isfinite(upper)
    lower, upper = (np.where(is_limited, end, 0.0) for end in (lower, upper))
    middle = (lower + upper) / 2
    half = np.minimum(np.where(is_limited, upper - middle, LARGEST_ANGLE), LARGEST_ANGLE)
    share = rng.uniform(-1, 1, (POSTURES, len(model.joints)))
    return model.apply_mimics(middle + share * half)


def annihilator(
    jacobian: FloatArray, damping: float, selection: FloatArray, *, orthonormal: bool = False
) -> FloatArray:
    """Return N = d E P (N, k, n) for a Jacobian J (N, r, n) and a selection E (k, n).

    With ``orthonormal`` rows it is d (E P Eᵀ)^(-1/2) E P, for k of at most n - r.
    """
    rank = jacobian.shape[1]
    Q, R = np.linalg.qr(jacobian.transpose(0, 2, 1), mode="complete")
    determinant = np.prod(np.diagonal(R, axis1=1, axis2=2) ** 2, axis=1)
    damped = np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1) + damping**2 * np.eye(rank))
    free = Q[:, :, rank:]
    selected = selection @ free
    if orthonormal:
        left, _, right = np.linalg.svd(selected, full_matrices=False)
        selected = left @ right
    N: FloatArray = selected @ free.transpose(0, 2, 1)
    N *= (determinant / damped)[:, None, None]
    return N


def without_contacts(model: RobotModel, samples: Samples, rows: FloatArray) -> FloatArray:
    """Return rows (N, n, c) of samples combined so that no contact enters them.

    The rows of other coordinates than ``coordinates`` of the contacts are zero. NaN in a row is
    also in the combinations that contain it. Where the samples do not tell which contacts touch
    something, all do.
    """
    return all_without_contacts(model, samples, rows)[0]


def all_without_contacts(
    model: RobotModel, samples: Samples, *arrays: FloatArray
) -> tuple[FloatArray, ...]:
    """Return what :func:`without_contacts` does with each of several arrays (N, n, c)."""
    contacts = model.contacts
    assert contacts is not None
    up = upward(samples) if contacts.radii.any() else None
    if samples.touching is None:
        return _combined(model, contacts, samples.position, arrays, up)
    results = tuple(np.zeros_like(rows) for rows in arrays)
    for state, index in contact_states(samples.touching):
        active = contacts_of_state(model, state)
        above = None if up is None else up[index]
        some = tuple(rows[index] for rows in arrays)
        found = _combined(model, active, samples.position[index], some, above)
        for result, each in zip(results, found, strict=True):
            result[index] = each
    return results


def variance_of_all_rows(
    model: RobotModel, samples: Samples, variance: FloatArray, correlation: FloatArray
) -> FloatArray:
    """Return the variance (N, n) of the rows of :func:`with_all_rows`.

    The independent rows r = N τ with orthonormal N have P τ = Nᵀ r, so the variance is the
    diagonal of Nᵀ C N for the covariance C of r.

    Parameters
    ----------
    model : RobotModel
        The robot with the rows of every coordinate.
    samples : Samples
        Postures, and which contacts touch something.
    variance : (n,) float64
        Of errors of the independent rows, the mean over postures; NaN or infinite if unknown.
    correlation : (n, n) float64
        Of these errors.
    """
    assert model.contacts is not None
    independent = replace(model, contacts=model.contacts.independent)
    unit = np.broadcast_to(np.eye(model.dof), (len(samples), model.dof, model.dof))
    N = without_contacts(independent, samples, unit)
    # Both kinds of rows contain the factor d.
    norm = np.linalg.norm(N, axis=2, keepdims=True)
    N = np.divide(N, norm, out=np.zeros_like(N), where=norm > 0)
    is_known = np.isfinite(variance)
    std = np.sqrt(np.where(is_known, variance, 0.0))
    found: FloatArray = np.sum(N * ((correlation * np.outer(std, std)) @ N), axis=1)
    found[(~is_known).astype(float) @ N**2 > NEGLIGIBLE] = np.inf
    return found


def combined_coordinates(model: RobotModel) -> tuple[int, ...]:
    """Return the coordinates whose rows are orthonormal combinations if all contacts touch."""
    contacts = model.contacts
    if contacts is None or contacts.has_all_rows:
        return ()
    loaded = np.asarray(contacts.loads.any(axis=0))
    return tuple(contacts.coordinates[loaded[contacts.coordinates]].tolist())


def possible_states(model: RobotModel) -> tuple[tuple[bool, ...], ...]:
    """Return every combination of contacts that may touch something; none if there are too many."""
    count = 0 if model.contacts is None else len(model.contacts.frames)
    return tuple(product((True, False), repeat=count)) if 0 < count <= MOST_FLAGGED else ()


def contact_states(touching: BoolArray) -> Iterator[tuple[tuple[bool, ...], IntArray]]:
    """Yield each set of contacts that touch something at once, and the samples of (N, F)."""
    if not touching.shape[1]:
        return
    states, place = np.unique(touching, axis=0, return_inverse=True)
    for number, state in enumerate(states.tolist()):
        yield tuple(state), np.flatnonzero(place.ravel() == number)


def _combined(
    model: RobotModel,
    contacts: Contacts,
    position: FloatArray,
    arrays: tuple[FloatArray, ...],
    up: FloatArray | None,
) -> tuple[FloatArray, ...]:
    """Return the combinations of rows (N, n, c) that no wrench of the contacts enters.

    The direction ``up`` (N, 3), in base axes, is needed for balls.
    """
    loaded = np.asarray(contacts.loads.any(axis=0))
    # Rows on which no contact acts stay as they are.
    free = contacts.coordinates[~loaded[contacts.coordinates]]
    combined = contacts.coordinates[loaded[contacts.coordinates]]
    N = np.zeros((len(position), 0, model.dof))
    if len(combined):
        poses = link_poses(model, position)
        J = contact_jacobian(model, contacts.frames, poses)
        if up is not None:
            J = _at_bottoms(J, model, contacts, poses, up)
        J = J[:, contacts.components]
        some = np.eye(model.dof)[combined]
        N = annihilator(J, contacts.damping, some, orthonormal=not contacts.has_all_rows)
    return tuple(_with_combinations(rows, free, combined, N) for rows in arrays)


def _with_combinations(
    rows: FloatArray, free: IntArray, combined: IntArray, N: FloatArray
) -> FloatArray:
    """Return rows (N, n, c): some as they are, combinations N (N, k, n) of others, else zeros."""
    result = np.empty_like(rows)
    others = np.setdiff1d(np.arange(rows.shape[1]), np.concatenate([free, combined]))
    result[:, others] = 0.0
    result[:, free] = rows[:, free]
    # Neighbours at once, into their place: a humanoid's rows are too large to copy them.
    for run in np.split(np.arange(len(combined)), np.flatnonzero(np.diff(combined) > 1) + 1):
        if not len(run):
            continue
        place = slice(int(combined[run[0]]), int(combined[run[-1]]) + 1)
        part = N[:, run[0] : run[-1] + 1]
        kept = np.matmul(part, rows, out=result[:, place])
        if np.isfinite(kept.sum()):
            continue
        # NaN times zero is NaN, so columns that contain NaN are combined without it.
        gaps = np.flatnonzero(~np.isfinite(kept).all(axis=(0, 1)))
        is_known = np.isfinite(rows[..., gaps])
        known = part @ np.where(is_known, rows[..., gaps], 0.0)
        known[(np.abs(part) > NEGLIGIBLE).astype(float) @ ~is_known > 0] = np.nan
        kept[..., gaps] = known
    return result


def _at_bottoms(
    J: FloatArray, model: RobotModel, contacts: Contacts, poses: LinkPoses, up: FloatArray
) -> FloatArray:
    """Return the contact Jacobian (N, 6 F, n) with forces at the lowest points of the balls."""
    J = J.copy()
    for index, (name, radius) in enumerate(zip(contacts.frames, contacts.radii, strict=True)):
        if not radius:
            continue
        frame = model.frame(name)
        axes = poses.rotation[:, frame.link] @ frame.rotation
        down = -radius * np.einsum("tji,tj->ti", axes, up)
        # A unit force there has the moment d × e about the origin.
        moments = J[:, 6 * index : 6 * index + 3]
        J[:, 6 * index + 3 : 6 * index + 6] += np.einsum("ikt,tin->tkn", skew(down.T), moments)
    return J
