"""How a link's identified parameters are divided among the bodies welded into it.

The data determine the sum alone, so the file's own division stays as far as it can.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import is_consistent, pseudo_inertia, transform_phi
from symbid_ros.model.tree import RobotModel

# Relative to a link's largest parameters: smaller changes are rounding.
ROUNDING = 1e-12
# Share of the largest possible part that the other bodies keep when one body cannot take all of
# the change; the rest stays with that body, which would otherwise be on the border.
_KEPT = 0.9


@dataclass(frozen=True)
class Division:
    """How a link's parameters are divided among the bodies welded into it.

    Attributes
    ----------
    taker : int
        The body that takes the change.
    phi : (10,) float64
        Its new parameters.
    kept : float
        Share of their mass that the others keep, with their shape and centre of mass.
    """

    taker: int
    phi: FloatArray
    kept: float


def divided(
    stated: FloatArray, total: FloatArray, *, first_can_carry: bool = True
) -> Division | None:
    """Divide ``total`` among welded bodies.

    The whole change goes to one body: the first, which is the one that the joint moves, or,
    if the file gives that one no inertia, the heaviest. Only if this body would become
    physically impossible, and the total is not, the others give up part of their mass.

    Parameters
    ----------
    stated : (B, 10) float64
        As the file states them, about the same point and in the same axes.
    total : (10,) float64
        Of all bodies together.
    first_can_carry : bool
        Whether the first body can have mass; MJCF's world cannot.

    Returns
    -------
    Division or None
        None if the bodies add up to ``total`` to within rounding, or none can take a change.
    """
    change = total - stated.sum(axis=0)
    taker = _taker(stated, first_can_carry)
    if taker is None or is_rounding(change, total):
        return None
    phi = stated[taker] + change
    others = np.delete(stated, taker, axis=0).sum(axis=0)
    if _possible(phi) or not np.any(others) or not _possible(total):
        return Division(taker, phi, 1.0)
    kept = _kept_share(others, stated.sum(axis=0), total)
    return Division(taker, total - kept * others, kept)


def is_rounding(change: FloatArray, value: FloatArray) -> bool:
    """Return whether a change of φ (10,) is rounding: of masses, moments and inertias apart."""
    return all(
        np.abs(change[part]).max() <= ROUNDING * np.abs(value[part]).max()
        for part in (slice(1), slice(1, 4), slice(4, None))
    )


def _taker(stated: FloatArray, first_can_carry: bool) -> int | None:
    if first_can_carry and np.any(stated[0]):
        return 0
    heaviest = int(np.argmax(stated[:, 0]))
    if stated[heaviest, 0] > 0:
        return heaviest
    return 0 if first_can_carry else None


def _kept_share(others: FloatArray, stated: FloatArray, total: FloatArray) -> float:
    """Return the share of their mass that the other bodies keep, in [0, 1]."""
    # The largest s with J(total) - s J(others) ⪰ 0 is one over the largest generalised eigenvalue.
    whole = pseudo_inertia(total)
    root = np.linalg.cholesky(whole + 1e-9 * np.diag(np.diag(whole)))
    half = np.linalg.solve(root, pseudo_inertia(others))
    largest = float(np.linalg.eigvalsh(np.linalg.solve(root, half.T))[-1])
    possible = _KEPT / largest if largest > 0 else 1.0
    lighter = total[0] / stated[0] if stated[0] > 0 else 1.0
    return float(min(1.0, possible, lighter))


def _possible(phi: FloatArray) -> bool:
    return bool(phi[0] > 0) and is_consistent(phi)


def updated_bodies(
    model: RobotModel, stated: Mapping[str, FloatArray], *, rewrite: bool = False
) -> dict[str, FloatArray]:
    """Return the bodies of a file whose parameters differ from what the file states.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    stated : mapping of str to (10,) float64
        φ of each body about its own origin, by the body's name. Bodies that are welded to a
        link are frames of ``model``.
    rewrite : bool
        Return all bodies that have inertia, changed or not.

    Returns
    -------
    dict of str to (10,) float64
        Their new φ, about their own origins.
    """
    groups: dict[int, list[str]] = {}
    for name in stated:
        link = model.frame(name).link
        members = groups.setdefault(link, [])
        members.insert(0 if name == model.links[link].name else len(members), name)
    updated = {}
    for link, names in groups.items():
        frames = [model.frame(name) for name in names]
        total = model.links[link].phi
        before = np.array(
            [transform_phi(stated[f.name], f.rotation, f.translation) for f in frames]
        )
        division = divided(before, total, first_can_carry=names[0] != "world")
        kept = 1.0 if division is None else division.kept
        for position, frame in enumerate(frames):
            if division is not None and position == division.taker:
                back = frame.rotation.T
                updated[frame.name] = transform_phi(division.phi, back, -back @ frame.translation)
            elif np.any(stated[frame.name]) and (rewrite or kept != 1.0):
                updated[frame.name] = kept * stated[frame.name]
    return updated
