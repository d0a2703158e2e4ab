"""Direction of gravity on a fixed base, found from the efforts of a log.

The model file of an arm on a wall or under a ceiling is usually that of the same arm on a table.
The rows of a fixed base are linear in gravity: K(g) = K(0) + Σ gᵢ (K(eᵢ) - K(0)) for unit vectors
eᵢ, so that rows for four directions give those for all. The best fits of the parameters in 26
directions are compared, and the best two directions are refined by Gauss-Newton steps.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.identification.conventions.loose_fit import LooseRows, loose_rows, some_blocks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import AXIS, DEVIATIONS

FEWEST_ROWS = 3  # per parameter of a link
# Joints that turn: a wrong zero of a lone one looks like another direction, and many take long.
FEWEST_JOINTS, MOST_JOINTS = 2, 40
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
STEPS, LONGEST_STEP, SMALLEST_STEP = 10, 0.3, 1e-4  # rad
DECIMALS = 6  # of a direction in an option
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
        """The direction as a value of the option `gravity`.

        Rounding errors are far below the accuracy of a long log; coarser ones would bias the
        parameters.
        """
        return " ".join(f"{one:.{DECIMALS}f}" for one in self.direction)

    def message(self, source: str) -> str:
        """Return one line that compares this direction with that of the model file ``source``."""
        along = ", ".join(f"{one:.3f}" for one in self.direction)
        return (
            f"the efforts say that gravity points along ({along}) in the "
            f"base's axes, which leaves {100 * self.after:.2g} % of them unexplained; that of "
            f"{source} leaves {100 * self.before:.2g} %"
        )

    def finding(self, source: str) -> Finding:
        """Return the doctor's finding about the model file ``source``."""
        figures = {f"gravity_{axis}": one for axis, one in zip("xyz", self.direction, strict=True)}
        line = robot_file_line("gravity", *map(float, self.value.split()))
        message = f"{self.message(source)}; give `gravity` {self.value}, or write {line}"
        return Finding(Kind.BASE_MOUNTING, "", Severity.WARNING, message, figures)


def searches_gravity(options: RobotOptions, robot: RobotModel) -> bool:
    """Return whether the direction of gravity is searched for in a log of a robot."""
    turning = sum(joint.kind == "revolute" for joint in robot.joints)
    is_known = options.gravity is not None or bool(options.contacts)
    return not robot.floating and not is_known and FEWEST_JOINTS <= turning <= MOST_JOINTS


def find_gravity(segments: Iterable[Segment], robot: RobotModel) -> FoundGravity | None:
    """Return the direction of gravity if the efforts of a log contradict a fixed base's model."""
    size = float(np.linalg.norm(robot.gravity))
    if size == 0.0:
        return None
    blocks = list(some_blocks(segments))
    axes = np.vstack([robot.gravity / size, np.linalg.svd(robot.gravity[None])[2][1:]])
    signed = (axes[0], -axes[0], *axes[1:])
    rows, *others = (loose_rows(blocks, replace(robot, gravity=size * one)) for one in signed)
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


@dataclass(frozen=True)
class _Directions:
    """Rows for all directions of gravity.

    Attributes
    ----------
    rows : LooseRows
        Of one direction.
    at_rest : (N, n, p) float64
        K without gravity.
    slopes : (3, N, n, p) float64
        Derivatives of K by gravity along the axes.
    axes : (3, 3) float64
        Unit vectors in base axes, one a row.
    """

    rows: LooseRows
    at_rest: FloatArray
    slopes: FloatArray
    axes: FloatArray

    def at(self, direction: FloatArray) -> LooseRows:
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
