"""Fits of a model to the efforts of a log, with inertias and friction that are hardly limited.

They compare the likelihood of several readings of a log, such as other directions of gravity.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import Term
from symbid_ros.diagnosis.model_statistics import is_taken
from symbid_ros.estimation.prior_std import body_std
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.weak_form import (
    ALL_WINDOWS,
    EquationRows,
    block_rows,
    cut_into_blocks,
    suitable_windows,
)

# Rows are made of all of the first blocks of a log, and of ever fewer of the others.
DENSE, MOST_BLOCKS = 8, 150
WINDOWS = ALL_WINDOWS[2:]  # the first that suits the rate is used
# Percent by which the model's inertias may be wrong, which are not those of a robot with a tool.
WIDE = 100.0
TERMS: tuple[Term, ...] = ("viscous", "coulomb", "armature", "offset")
# Friction may give the robot this share of the power that the efforts have, by chance.
GIVEN = 0.02
PASSES = 3  # of the deviations of residuals
LEAST_RESIDUAL = 1e-3  # share of a joint's efforts
LEAST_READ = 1e-3  # of a coordinate's efforts, relative to the largest
LOOSE = 30.0  # prior deviation of friction, armature and offsets, in efforts of the joint


def some_blocks(segments: Iterable[Segment]) -> Iterator[Segment]:
    """Yield the first blocks of a log, and ever fewer of the others."""
    every = (block for segment in segments for block in cut_into_blocks(segment))
    for number, block in enumerate(islice(every, MOST_BLOCKS), start=1):
        if is_taken(number, DENSE):
            yield block


def loose_rows(blocks: Iterable[Segment], robot: RobotModel) -> "LooseRows | None":
    """Return the rows of blocks, averaged over windows; None if no block is long enough."""
    parameters = ParameterSet(robot, TERMS)
    build = EquationRows(parameters)
    found = [
        block_rows(block, build, windows, (), shortest=windows[0])[0]
        for block in blocks
        if (windows := suitable_windows(WINDOWS, block.rate)[:1])
    ]
    if not found:
        return None
    valid = np.concatenate([one.valid for one in found])
    y = np.concatenate([one.mean.y for one in found])
    return LooseRows(parameters, np.concatenate([one.mean.K for one in found]), y, valid)


@dataclass(frozen=True)
class LooseFit:
    """Parameters that fit rows best.

    Attributes
    ----------
    theta : (p,) float64
    cost : float
        Negative logarithm of the likelihood and the prior.
    unexplained : float
        Root mean square of the residuals over that of y.
    shares : (J,) float64
        The same for the efforts of each joint.
    power, power_std : (J,) float64
        What friction takes of each joint's power, over that of the effort, and its standard
        deviation.
    dissipates : bool
        Whether friction takes power.
    """

    theta: FloatArray
    cost: float
    unexplained: float
    shares: FloatArray
    power: FloatArray
    power_std: FloatArray
    dissipates: bool


@dataclass(frozen=True)
class LooseRows:
    """Rows K θ = y of N windows.

    Attributes
    ----------
    parameters : ParameterSet
        θ (p,): links, viscous and Coulomb friction, armature, offsets.
    K : (N, n, p) float64
    y : (N, n) float64
    valid : (N, n) bool
    """

    parameters: ParameterSet
    K: FloatArray
    y: FloatArray
    valid: BoolArray

    @classmethod
    def joined(cls, parts: Sequence["LooseRows"]) -> "LooseRows":
        """Return the rows of all parts of a log, at least one, in their order."""
        arrays = zip(*((one.K, one.y, one.valid) for one in parts), strict=True)
        return cls(parts[0].parameters, *(np.concatenate(each) for each in arrays))

    @property
    def _coordinates(self) -> IntArray:
        """Those of the joints."""
        return 6 * self.parameters.model.floating + self.parameters.joints

    @cached_property
    def mean(self) -> FloatArray:
        """(p,) of the prior."""
        mean = np.zeros(self.K.shape[2])
        inertial = slice(0, self.parameters.inertial)
        mean[inertial] = self.parameters.values[inertial]
        return mean

    @cached_property
    def read(self) -> FloatArray:
        """(n,) root mean squares of the efforts; coordinates without effort count a little."""
        count = np.maximum(self.valid.sum(axis=0), 1)
        read = np.sqrt(np.sum(np.where(self.valid, self.y, 0.0) ** 2, axis=0) / count)
        return np.asarray(np.maximum(read, max(LEAST_READ * float(read.max()), 1e-9)))

    @property
    def has_rows(self) -> BoolArray:
        """(J,) whether any row of a joint is valid."""
        return np.asarray(np.any(self.valid[:, self._coordinates], axis=0))

    @cached_property
    def variation_cost(self) -> float:
        """Cost of fitting each coordinate's efforts by a constant.

        Subtracting it makes the costs of different efforts comparable: what remains depends on the
        share of the variation that a fit leaves unexplained.
        """
        count = np.maximum(self.valid.sum(axis=0), 1)
        y = np.where(self.valid, self.y, 0.0)
        variance = np.where(self.valid, y - y.sum(axis=0) / count, 0.0) ** 2
        std = np.sqrt(variance.sum(axis=0) / count)
        return float(count @ np.log(np.maximum(std, LEAST_RESIDUAL * self.read)))

    @cached_property
    def std(self) -> FloatArray:
        """(p,) of the prior; what drives do is hardly limited."""
        std = np.full(self.K.shape[2], LOOSE * self.read.max())
        links = self.parameters.link_phi(self.mean)
        std[: self.parameters.inertial] = np.concatenate([body_std(one, WIDE) for one in links])
        for columns in self.parameters.term_columns.values():
            std[columns] = LOOSE * self.read[self._coordinates]
        return np.asarray(np.maximum(std, 1e-9))

    def fit(self, more: FloatArray | None = None) -> LooseFit:
        """Return the best fit; rows are weighted by the residuals of their coordinate.

        ``more`` (N, n, m) are columns of further unknowns with a prior deviation of one.
        """
        K, mean, std = self.K, self.mean, self.std
        if more is not None:
            K, extra = np.concatenate([K, more], axis=2), more.shape[2]
            mean, std = np.append(mean, np.zeros(extra)), np.append(std, np.ones(extra))
        left = np.where(self.valid, self.y - K @ mean, 0.0)
        count = np.maximum(self.valid.sum(axis=0), 1)
        # Moments of the rows of each coordinate; their weights change from pass to pass.
        scaled = np.where(self.valid[..., None], K * std, 0.0).transpose(1, 2, 0)
        H = scaled @ scaled.transpose(0, 2, 1)
        g = np.einsum("jpn,nj->jp", scaled, left, optimize=True)
        square = np.sum(left**2, axis=0)
        by_friction, given = self._power
        by_friction = std * np.pad(by_friction, ((0, 0), (0, len(std) - by_friction.shape[1])))
        deviation, x = self.read, np.zeros(len(std))
        for _ in range(PASSES):
            weight = deviation**-2
            information = np.tensordot(weight, H, axes=1) + np.eye(len(x))
            x = np.linalg.solve(information, weight @ g)
            square_left = square + (H @ x - 2 * g) @ x
            size = np.sqrt(np.maximum(square_left, 0.0) / count)
            deviation = np.maximum(size, LEAST_RESIDUAL * self.read)
        theta = mean + std * x
        cost = float(count @ np.log(deviation) + x @ x / 2)
        share = float(np.linalg.norm(size) / np.linalg.norm(self.read))
        shares = (size / self.read)[6 * self.parameters.model.floating :]
        taken = by_friction @ (theta / std)
        spread = by_friction @ np.linalg.solve(information, by_friction.T)
        given = np.maximum(given, 1e-300)
        return LooseFit(
            theta,
            cost,
            share,
            shares,
            taken / given,
            np.sqrt(spread.diagonal()) / given,
            taken.sum() > -GIVEN * given.sum(),
        )

    @cached_property
    def _power(self) -> tuple[FloatArray, FloatArray]:
        """Rows (J, p) of what friction takes, and sums (J,) of the sizes of the efforts' power."""
        columns = self.parameters.term_columns
        joints = len(self.parameters.model.joints)
        by_friction, given = np.zeros((joints, self.K.shape[2])), np.zeros(joints)
        for place, joint in enumerate(self._coordinates.tolist()):
            K, y = self.K[self.valid[:, joint], joint], self.y[self.valid[:, joint], joint]
            own = [columns[term].start + place for term in ("viscous", "coulomb")]
            rate = K[:, own[0]]
            at = joint - 6 * self.parameters.model.floating
            by_friction[at, own] = rate @ K[:, own]
            given[at] = np.abs(y) @ np.abs(rate)
        return by_friction, given
