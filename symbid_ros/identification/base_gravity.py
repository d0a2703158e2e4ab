"""Direction of gravity on a fixed base, found from the efforts of a log.

The model file of an arm on a wall or under a ceiling is usually that of the same arm on a table.
The rows of a fixed base are linear in gravity: K(g) = K(0) + Σ gᵢ (K(eᵢ) - K(0)) for unit vectors
eᵢ, so that rows for four directions give those for all. The best fits of the parameters in 26
directions are compared, and the best two directions are refined by Gauss-Newton steps.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, product

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import Term
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.model_statistics import is_taken
from symbid_ros.estimation.prior_std import body_std
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import AXIS, DEVIATIONS
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
FEWEST_ROWS = 3  # per parameter of a link
# Joints that turn: a wrong zero of a lone one looks like another direction, and many take long.
FEWEST_JOINTS, MOST_JOINTS = 2, 40
# Percent by which the model's inertias may be wrong, which are not those of a robot with a tool.
WIDE = 100.0
TERMS: tuple[Term, ...] = ("viscous", "coulomb", "armature", "offset")
# Directions far from the model's are tried if that leaves this share of the efforts unexplained
# (RMS), or if the opposite one fits as well. Real drives leave up to 0.15 with the right one.
UNEXPLAINED = 0.1
# Another direction has to be likelier by this many nats, and by this many for each row. What models
# of real arms lack brings up to 0.13, with directions 1 to 4 degrees off.
EVIDENCE, LEAST_GAIN = 50.0, 0.35
# Largest wrong zero of an encoder, rad, and how far a direction turns otherwise.
LARGEST_ZERO, ALONG = 0.26, 0.3
# Largest tilt that is left to the axis of the first joint if that is unknown, rad.
TILTED_AXIS = 5 * DEVIATIONS[AXIS][0]
# Efforts of which more is left are wrong in other ways.
MOST_LEFT = 0.2
# Friction may give the robot this share of the power that the efforts have, by chance.
GIVEN = 0.02
PASSES = 3  # of the deviations of residuals
STEPS, LONGEST_STEP, SMALLEST_STEP = 10, 0.3, 1e-4  # rad
LEAST_RESIDUAL = 1e-3  # share of a joint's efforts
LEAST_READ = 1e-3  # of a coordinate's efforts, relative to the largest
LOOSE = 30.0  # prior deviation of friction, armature and offsets, in efforts of the joint
KEPT = 2  # directions that are refined
DIRECTIONS = np.array([one for one in product((-1.0, 0.0, 1.0), repeat=3) if any(one)])

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FoundGravity:
    """A direction of gravity that explains the efforts, unlike the model's.

    Attributes
    ----------
    direction : tuple of float
        Unit vector (3,) in base axes.
    before, after : float
        Share of the efforts (RMS) that the model's direction and this one leave unexplained.
    """

    direction: tuple[float, float, float]
    before: float
    after: float

    def angle(self, robot: RobotModel) -> float:
        """Return the angle between this direction and the model's, rad."""
        down = robot.gravity / np.linalg.norm(robot.gravity)
        cross = np.linalg.norm(np.cross(down, self.direction))
        return float(np.arctan2(cross, down @ self.direction))

    @property
    def value(self) -> str:
        """The direction as a value of the option `gravity`."""
        return " ".join(f"{one:.3f}" for one in self.direction)

    def message(self, source: str) -> str:
        """Return one line that compares this direction with that of the model file ``source``."""
        return (
            f"the efforts say that gravity points along ({', '.join(self.value.split())}) in the "
            f"base's axes, which leaves {100 * self.after:.2g} % of them unexplained; that of "
            f"{source} leaves {100 * self.before:.2g} %"
        )

    def finding(self, source: str) -> Finding:
        """Return the doctor's finding about the model file ``source``."""
        figures = {f"gravity_{axis}": one for axis, one in zip("xyz", self.direction, strict=True)}
        line = robot_file_line("gravity", *(round(one, 3) for one in self.direction))
        message = f"{self.message(source)}; give `gravity` {self.value}, or write {line}"
        return Finding(Kind.BASE_MOUNTING, "", Severity.WARNING, message, figures)


def searches_gravity(options: RobotOptions, robot: RobotModel) -> bool:
    """Return whether the direction of gravity is searched for in a log of a robot."""
    turning = sum(joint.kind == "revolute" for joint in robot.joints)
    is_known = options.gravity is not None or bool(options.contacts)
    return not robot.floating and not is_known and FEWEST_JOINTS <= turning <= MOST_JOINTS


def find_gravity(segments: Iterable[Segment], robot: RobotModel) -> FoundGravity | None:
    """Return the direction of gravity if the efforts of a log contradict the model's.

    Parameters
    ----------
    segments : iterable of Segment
        Of the log.
    robot : RobotModel
        With a fixed base.
    """
    size = float(np.linalg.norm(robot.gravity))
    if size == 0.0:
        return None
    blocks = list(_blocks(segments))
    axes = np.vstack([robot.gravity / size, np.linalg.svd(robot.gravity[None])[2][1:]])
    signed = (axes[0], -axes[0], *axes[1:])
    rows, *others = (_rows(blocks, replace(robot, gravity=size * one)) for one in signed)
    if rows is None or rows.valid.sum() < FEWEST_ROWS * len(ParameterSet(robot)):
        return None
    opposite, *across = (one.K for one in others if one is not None)
    at_rest = (rows.K + opposite) / 2
    slopes = np.stack([rows.K - at_rest, *(one - at_rest for one in across)])
    directions = _Directions(rows, at_rest, slopes, axes)
    own, other_way = rows.fit(), directions.at(-axes[0]).fit()
    is_doubted = own.unexplained > UNEXPLAINED or other_way.cost < own.cost + EVIDENCE
    best = directions.best(axes[0], everywhere=is_doubted)
    fit = directions.at(best).fit()
    # Of efforts with the wrong sign the opposite direction explains all but inertia and friction.
    reversed_ = replace(rows, y=-rows.y).fit()
    rivals = [own.cost, *([reversed_.cost] if reversed_.dissipates else [])]
    gain = min(rivals) - fit.cost
    if gain < max(EVIDENCE, LEAST_GAIN * rows.valid.sum()):
        return None
    if fit.unexplained > MOST_LEFT or not fit.dissipates or _is_wrong_zero(robot, best):
        return None
    x, y, z = best.tolist()
    return FoundGravity((x, y, z), own.unexplained, fit.unexplained)


def _is_wrong_zero(robot: RobotModel, direction: FloatArray) -> bool:
    """Return whether a wrong zero of the encoder of a first joint looks like this direction.

    The base and all that it carries then turn about the joint's axis, by a small angle.
    """
    firsts = [joint for joint in robot.joints if joint.parent == 0 and joint.kind == "revolute"]
    if len(firsts) != 1:
        return False
    down = robot.gravity / np.linalg.norm(robot.gravity)
    axis, change = firsts[0].rotation @ firsts[0].axis, direction - down
    size = float(np.linalg.norm(change))
    lever = float(np.linalg.norm(np.cross(axis, down)))  # none if the axis is vertical
    return size < LARGEST_ZERO * lever and abs(float(axis @ change)) < ALONG * size


def _blocks(segments: Iterable[Segment]) -> Iterator[Segment]:
    every = (block for segment in segments for block in cut_into_blocks(segment))
    for number, block in enumerate(islice(every, MOST_BLOCKS), start=1):
        if is_taken(number, DENSE):
            yield block


def _rows(blocks: Iterable[Segment], robot: RobotModel) -> "_Rows | None":
    """Return the rows of blocks, averaged over windows; None if no block is long enough."""
    parameters = ParameterSet(robot, TERMS)
    build = EquationRows(parameters)
    found = [
        block_rows(block, build, windows, ())[0]
        for block in blocks
        if (windows := suitable_windows(WINDOWS, block.rate)[:1])
    ]
    if not found:
        return None
    valid = np.concatenate([one.valid for one in found])
    y = np.concatenate([one.mean.y for one in found])
    return _Rows(parameters, np.concatenate([one.mean.K for one in found]), y, valid)


@dataclass(frozen=True)
class _Fit:
    """Parameters that fit rows best.

    Attributes
    ----------
    theta : (p,) float64
    cost : float
        Negative logarithm of the likelihood and the prior.
    unexplained : float
        Root mean square of the residuals over that of y.
    dissipates : bool
        Whether friction takes power.
    """

    theta: FloatArray
    cost: float
    unexplained: float
    dissipates: bool


@dataclass(frozen=True)
class _Rows:
    """Rows K θ = y of N windows for one direction of gravity.

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

    @cached_property
    def std(self) -> FloatArray:
        """(p,) of the prior; what drives do is hardly limited."""
        std = np.full(self.K.shape[2], LOOSE * self.read.max())
        links = self.parameters.link_phi(self.mean)
        std[: self.parameters.inertial] = np.concatenate([body_std(one, WIDE) for one in links])
        for columns in self.parameters.term_columns.values():
            std[columns] = LOOSE * self.read[self.parameters.joints]
        return np.asarray(np.maximum(std, 1e-9))

    def fit(self, more: FloatArray | None = None) -> _Fit:
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
        deviation, x = self.read, np.zeros(len(std))
        for _ in range(PASSES):
            weight = deviation**-2
            x = np.linalg.solve(np.tensordot(weight, H, axes=1) + np.eye(len(x)), weight @ g)
            square_left = square + (H @ x - 2 * g) @ x
            size = np.sqrt(np.maximum(square_left, 0.0) / count)
            deviation = np.maximum(size, LEAST_RESIDUAL * self.read)
        theta = mean + std * x
        cost = float(count @ np.log(deviation) + x @ x / 2)
        share = float(np.linalg.norm(size) / np.linalg.norm(self.read))
        return _Fit(theta, cost, share, self._dissipates(theta))

    def _dissipates(self, theta: FloatArray) -> bool:
        """Return whether friction takes power, apart from what chance gives."""
        columns = self.parameters.term_columns
        viscous, coulomb = columns["viscous"].start, columns["coulomb"].start
        taken = given = 0.0
        for place, joint in enumerate(self.parameters.joints.tolist()):
            K, y = self.K[self.valid[:, joint], joint], self.y[self.valid[:, joint], joint]
            rate, sign = K[:, viscous + place], K[:, coulomb + place]
            friction = theta[viscous + place] * rate + theta[coulomb + place] * sign
            taken += float(friction @ rate)
            given += float(np.abs(y) @ np.abs(rate))
        return taken > -GIVEN * given


@dataclass(frozen=True)
class _Directions:
    """Rows for all directions of gravity.

    Attributes
    ----------
    rows : _Rows
        Of one direction.
    at_rest : (N, n, p) float64
        K without gravity.
    slopes : (3, N, n, p) float64
        Derivatives of K by gravity along the axes.
    axes : (3, 3) float64
        Unit vectors in base axes, one a row.
    """

    rows: _Rows
    at_rest: FloatArray
    slopes: FloatArray
    axes: FloatArray

    def at(self, direction: FloatArray) -> _Rows:
        """Return the rows for a unit vector."""
        return replace(self.rows, K=self.at_rest + self._slope(direction))

    def _slope(self, direction: FloatArray) -> FloatArray:
        """Return the derivative (N, n, p) of K by gravity along a unit vector."""
        return np.asarray(np.tensordot(self.axes @ direction, self.slopes, axes=1))

    def best(self, near: FloatArray, *, everywhere: bool) -> FloatArray:
        """Return the unit vector with the least cost, near another one or everywhere."""
        refined = [self._refined(near)]
        if everywhere:
            grid = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
            costs = [self.at(one).fit().cost for one in grid]
            refined += [self._refined(grid[place]) for place in np.argsort(costs)[:KEPT]]
        return refined[int(np.argmin([self.at(one).fit().cost for one in refined]))]

    def _refined(self, direction: FloatArray) -> FloatArray:
        for _ in range(STEPS):
            rows = self.at(direction)
            theta = rows.fit().theta
            tangents = np.linalg.svd(direction[None])[2][1:]
            turned = [self._slope(one) @ theta for one in tangents]
            step = rows.fit(np.stack(turned, axis=2)).theta[-len(tangents) :]
            length = float(np.linalg.norm(step))
            direction = direction + min(1.0, LONGEST_STEP / max(length, 1e-12)) * step @ tangents
            direction = direction / np.linalg.norm(direction)
            if length < SMALLEST_STEP:
                break
        return direction


def with_found_gravity(
    options: IdentifyOptions, robot: RobotModel, segments: Iterable[Segment], source: str
) -> IdentifyOptions:
    """Return options with the direction of gravity that a log shows, and log a warning.

    They are returned as they are if the log does not contradict the model, or if an unknown axis of
    the first joint explains the direction. Both tilt all that the base carries.
    """
    if not searches_gravity(options, robot):
        return options
    found = find_gravity(segments, robot)
    if found is None:
        return options
    if AXIS in options.sensor_error_kinds and found.angle(robot) < TILTED_AXIS:
        return options
    logger.warning(
        "%s: %s; this direction is used, `gravity` gives another",
        source,
        found.message(robot.source),
    )
    return replace(options, gravity=found.direction)
