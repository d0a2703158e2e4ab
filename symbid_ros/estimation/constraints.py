"""Constraints beside data and prior: total mass, left/right symmetry and linear bounds.

A weighing and the symmetry have standard deviations and are pseudo-measurements,
row · φ = target with unit variance. Bounds are hard constraints.
"""

import re
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.errors import EstimateError
from symbid_ros.model.inertia import transform_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

# Largest deviation of two joints from mirror images, in m and in rad.
MIRROR_TOLERANCE = 1e-4

_MIRROR = np.diag([1.0, -1.0, 1.0])
# Sides, and corners of quadrupeds such as FL and RL, or LF and LH.
_RIGHT_OF = {"left": "right", "l": "r"} | {
    corner: corner.replace("l", "r") for corner in ("fl", "rl", "hl", "lf", "lh", "lr")
}


@dataclass(frozen=True)
class Bounds:
    """Linear bounds lower ≤ matrix φ ≤ upper. Equal bounds are an equation.

    Attributes
    ----------
    names : tuple of str
        Names of the k rows, for messages.
    matrix : (k, p) float64
        Rows for the first p parameters, in units of the bound per unit of the parameter.
    lower, upper : (k,) float64
        Infinite where there is no bound.
    """

    names: tuple[str, ...]
    matrix: FloatArray
    lower: FloatArray
    upper: FloatArray

    def __post_init__(self) -> None:
        """Reject rows without a parameter, and bounds that no number satisfies."""
        for name, row in zip(self.names, self.matrix, strict=True):
            if not (np.all(np.isfinite(row)) and np.any(row)):
                raise EstimateError(
                    f"{name}: the bound concerns no parameter; correct its row", "E414"
                )
        for name, lower, upper in zip(self.names, self.lower, self.upper, strict=True):
            if not lower <= upper or lower == np.inf or upper == -np.inf:
                raise EstimateError(
                    f"{name}: nothing lies between {lower:g} and {upper:g}; correct the bounds",
                    "E414",
                )

    @classmethod
    def total_mass(cls, parameters: ParameterSet, lower: float, upper: float) -> "Bounds":
        """Return bounds on the robot's mass, kg."""
        row = _mass_row(parameters)[None]
        return cls(("total mass",), row, np.array([lower]), np.array([upper]))

    @classmethod
    def nonnegative(cls, parameters: ParameterSet) -> "Bounds":
        """Return the bounds friction ≥ 0 and armature ≥ 0; a torque offset may be negative."""
        chosen = parameters.nonnegative
        names = tuple(parameters.names[i] for i in np.flatnonzero(chosen))
        zeros = np.zeros(len(names))
        return cls(names, np.eye(len(parameters))[chosen], zeros, zeros + np.inf)

    def one_sided(self, count: int) -> tuple[FloatArray, FloatArray, int]:
        """Return matrix (k', count), offset (k',) and the number e of equations.

        The first e rows mean matrix φ - offset = 0, the others ≥ 0. Parameters beyond the bounds'
        own columns are free.
        """
        equal = self.lower == self.upper
        below, above = (np.isfinite(side) & ~equal for side in (self.lower, self.upper))
        matrix = [self.matrix[equal], self.matrix[below], -self.matrix[above]]
        offset = [self.lower[equal], self.lower[below], -self.upper[above]]
        beyond = (0, 0), (0, count - self.matrix.shape[1])
        return (
            np.pad(np.concatenate(matrix), beyond),
            np.concatenate(offset),
            int(equal.sum()),
        )

    def __add__(self, other: "Bounds") -> "Bounds":
        """Return both bounds together."""
        return Bounds(
            self.names + other.names,
            np.concatenate([self.matrix, other.matrix]),
            np.concatenate([self.lower, other.lower]),
            np.concatenate([self.upper, other.upper]),
        )


def total_mass_row(parameters: ParameterSet, mass: float, std: float) -> tuple[FloatArray, float]:
    """Return the row (p,) and target of a weighing, Σ m = ``mass`` ± ``std`` kg.

    Raises
    ------
    EstimateError
        When the mass or its standard deviation is not a positive number.
    """
    if not (0 < mass < np.inf and 0 < std < np.inf):
        raise EstimateError(
            f"a total mass of {mass:g} ± {std:g} kg is not valid; give two positive numbers",
            "E414",
        )
    return _mass_row(parameters) / std, mass / std


def _mass_row(parameters: ParameterSet) -> FloatArray:
    row = np.zeros(len(parameters))
    row[: parameters.inertial : 10] = 1.0
    return row


@dataclass(frozen=True)
class MirrorPair:
    """Two links that are mirror images about the base's x-z plane.

    Attributes
    ----------
    left, right : str
        Link names.
    transform : (10, 10) float64
        Maps the right link's φ to the left link's. It is diagonal with signs ±1 if the frames are
        mirror images in one axis.
    """

    left: str
    right: str
    transform: FloatArray


def mirror_pairs(parameters: ParameterSet) -> tuple[MirrorPair, ...]:
    """Find pairs of left and right links by name and kinematics.

    Names are paired by a word for the side (``left_foot``, ``hip_l``, ``FL_calf``, ``LThigh``).
    A pair is accepted if its parent and child joints are mirror images about the base's x-z plane
    (REP-103: y points left) with all joints at zero. The orientation of the frames is arbitrary.
    """
    model = parameters.model
    poses = link_poses(model, np.zeros((1, len(model.joints))))
    rotation, position = poses.rotation[0], poses.position[0]
    pairs = []
    for left_name in parameters.link_names:
        right_name = next(
            (name for name in _other_side(left_name) if name in parameters.link_names), None
        )
        if right_name is None:
            continue
        left, right = (model.link_names.index(name) for name in (left_name, right_name))
        if not _mirrored(model, rotation, position, left, right):
            continue
        turn = rotation[left].T @ _MIRROR @ rotation[right]
        offset = rotation[left].T @ (_MIRROR @ position[right] - position[left])
        # The pseudo-inertia's second moments transform under reflections too.
        transform = np.array([transform_phi(unit, turn, offset) for unit in np.eye(10)]).T
        transform[np.abs(transform) < 1e-12] = 0.0
        pairs.append(MirrorPair(left_name, right_name, transform))
    return tuple(pairs)


def mirror_rows(
    parameters: ParameterSet, std: FloatArray, ratio: float
) -> tuple[FloatArray, FloatArray]:
    """Return rows (10 k, p) and targets (10 k,) that tie all k :func:`mirror_pairs`.

    Parameters
    ----------
    parameters : ParameterSet
        The robot's parameters.
    std : (p,) float64
        Prior standard deviations.
    ratio : float
        Standard deviation of the difference between left and mirrored right link, in units of the
        prior's deviations (root mean square of both sides).

    Raises
    ------
    EstimateError
        When the ratio is not positive or the robot has no such pair.
    """
    if not 0 < ratio < np.inf:
        raise EstimateError(f"`mirror` {ratio:g} is not valid; give a positive number", "E414")
    pairs = mirror_pairs(parameters)
    if not pairs:
        raise EstimateError(
            f"{parameters.model.source}: no two links are named left and right and mirror images "
            "about the base's x-z plane; leave `mirror` out",
            "E415",
        )
    rows = np.zeros((len(pairs), 10, len(parameters)))
    for row, pair in zip(rows, pairs, strict=True):
        left, right = (
            slice(start := 10 * parameters.link_names.index(name), start + 10)
            for name in (pair.left, pair.right)
        )
        variance = std[left] ** 2 + pair.transform**2 @ std[right] ** 2
        weight = 1.0 / (ratio * np.sqrt(variance / 2.0))
        row[:, left] = np.diag(weight)
        row[:, right] = -weight[:, None] * pair.transform
    stacked = rows.reshape(-1, len(parameters))
    return stacked, np.zeros(len(stacked))


def _other_side(name: str) -> list[str]:
    """Return possible names of the right link if ``name`` is that of a left link."""
    words = re.split(r"([_\-./ ])", name)
    found = []
    for index, word in enumerate(words):
        other = _RIGHT_OF.get(word.lower())
        if other is not None:
            other = other.upper() if word.isupper() else other
            other = other.capitalize() if word.istitle() and len(word) > 1 else other
            found.append("".join([*words[:index], other, *words[index + 1 :]]))
    if re.match(r"L[A-Z]|l[A-Z]", name):
        found.append(("R" if name[0] == "L" else "r") + name[1:])
    if re.match(r"[Ll]eft[A-Z]", name):
        found.append(("Right" if name[0] == "L" else "right") + name[4:])
    return found


def _mirrored(
    model: RobotModel, rotation: FloatArray, position: FloatArray, left: int, right: int
) -> bool:
    """Return whether the joints at two links are mirror images in the base frame."""

    def is_mirror_image(one: int, other: int) -> bool:
        joints = model.joints[one - 1], model.joints[other - 1]
        kinds = {joint.kind for joint in joints}
        axis, image = (
            rotation[link] @ joint.axis for link, joint in zip((one, other), joints, strict=True)
        )
        image = _MIRROR @ image
        apart = position[one] - _MIRROR @ position[other]
        # A hinge's origin may be anywhere on its axis; a slide's axis has no position.
        apart = np.cross(axis, apart) if kinds == {"revolute"} else np.zeros(3)
        deviation = max(np.linalg.norm(np.cross(axis, image)), np.linalg.norm(apart))
        return len(kinds) == 1 and bool(deviation < MIRROR_TOLERANCE)

    def children(link: int) -> list[int]:
        return [k + 1 for k, joint in enumerate(model.joints) if joint.parent == link]

    if 0 in (left, right) or not is_mirror_image(left, right):
        return False
    ours, theirs = children(left), children(right)
    return len(ours) == len(theirs) and all(
        any(is_mirror_image(one, other) for other in theirs) for one in ours
    )
