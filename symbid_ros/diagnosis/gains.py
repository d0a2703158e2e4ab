"""The sensors' gains from rows in which they are unknowns, under a model that may be wrong."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import JOINT_TERMS
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import INFLATION

# Share of a load below which nothing is asked of the rows. Gains that all shrink together with
# the inertias explain any log but for its noise; what is left of that must count for nothing.
FLOOR = 0.02
# How far off the model's inertias make its loads, roughly: weights of the very first solution.
OFF = 0.3
TURNS = 3
# Before the data: an element of A or M, and g, may be off by several times themselves and a
# stream be late by a tenth of a second.
GAIN_STD, DELAY_STD = 2.0, 0.1
PINNED = 1e-6  # standard deviation of what is held at its prior
# Standard deviation to which gains are held where delays alone are asked for.
NEARLY_PINNED = 1e-2
# Share of a load below which a residual is rounding.
LEAST = 1e-4


@dataclass(frozen=True)
class GainProblem:
    """Rows of [K, -C] [φ; θ] = y and what is believed of the unknowns.

    Attributes
    ----------
    rows : CoordinateRows
        Of n coordinates.
    mean, std : (p,) float64
        Of the parameters φ alone.
    gains : GainLayout
        What the r unknowns θ after them are.
    """

    rows: CoordinateRows
    mean: FloatArray
    std: FloatArray
    gains: GainLayout

    @classmethod
    def of(
        cls, rows: CoordinateRows, parameters: ParameterSet, std: FloatArray, gains: GainLayout
    ) -> "GainProblem":
        """Believe inertias to deviations (inertial,), and of drives that they are no load."""
        mean = parameters.values
        std = np.concatenate([std, np.zeros(len(mean) - len(std))])
        first = parameters.model.dof - len(parameters.model.joints)
        load = loads(rows, np.append(mean, np.zeros(len(gains))))[first:]
        for term, columns in parameters.term_columns.items():
            for joint, column in enumerate(range(columns.start, columns.stop)):
                size = np.sqrt(rows.column_squares(first + joint, column))
                share = JOINT_TERMS[term].load_share
                std[column] = share * load[joint] / max(size, 1e-9) + PINNED
        return cls(rows, mean, std, gains)

    @property
    def expected(self) -> FloatArray:
        """(p + r,) unknowns of the model with gains of one."""
        return np.append(self.mean, np.zeros(len(self.gains)))

    def solve(self, std: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the most probable unknowns (p + r,) and L of their covariance L Lᵀ.

        Parameters
        ----------
        std : (r,) float64
            Deviations of the gains and delays.
        left : (n,) float64
            Mean squares by which the rows may miss.
        """
        scale = np.append(self.std, std)
        mean, q = self.expected, len(scale)
        rows = self.rows.whitened(np.sqrt(INFLATION * left))
        square = stacked_factor(
            np.column_stack([rows[:, :-1] * scale, rows[:, -1] - rows[:, :-1] @ mean]),
            np.eye(q, q + 1),
        )
        R = square[:q, :q]
        deviation: FloatArray = scale[:, None] * solve_triangular(R, np.eye(q))
        return mean + scale * solve_triangular(R, square[:q, q]), deviation


@dataclass(frozen=True)
class GainEstimate:
    """Gains, delays and inertias that make the equation of motion hold.

    Attributes
    ----------
    sensors : GainLayout
        What the unknowns are.
    mean : (r,) float64
        Each unknown, less what it should be.
    covariance : (r, r) float64
        Of these, whatever the inertias are.
    left : (n,) float64
        Mean squares of what is left of each coordinate.
    before, after : float
        Root mean square of what is left of the base's force, N: of the model itself with
        all gains one, and with these.
    """

    sensors: GainLayout
    mean: FloatArray
    covariance: FloatArray
    left: FloatArray
    before: float
    after: float

    def matrix(self, place: slice) -> tuple[FloatArray, FloatArray]:
        """Return A or M (3, 3) of a sensor and the covariance (9, 9) of its rows."""
        return self.mean[place].reshape(3, 3) + np.eye(3), self.covariance[place, place]

    def delay(self, place: int) -> tuple[float, float]:
        """Return how late a sensor is and the standard deviation of that, s."""
        return float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))

    def effort(self, index: int) -> tuple[float, float]:
        """Return g of a driven joint and its standard deviation."""
        place = self.sensors.efforts.start + index
        return 1 + float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))


def estimate_gains(problem: GainProblem) -> GainEstimate:
    """Return the most probable gains of wrenches and efforts; IMUs are believed.

    Rows of one coordinate are weighed by what is left of them, no less than `FLOOR` of the load:
    the first time with gains of one, so that what does not fit at all says little.
    """
    rows, gains = problem.rows, problem.gains
    scale = loads(rows, problem.expected)
    pinned = np.full(len(gains), PINNED)
    at, _ = problem.solve(pinned, (OFF * scale) ** 2)
    left = rows.residual_squares(at)
    free = np.where(gains.is_imu, PINNED, _free(gains))
    for _ in range(TURNS):
        at, deviation = problem.solve(free, left + (FLOOR * scale) ** 2)
        left = rows.residual_squares(at)
    return _gains(problem, at, deviation, left)


def estimate_delays(problem: GainProblem) -> GainEstimate:
    """Return the most probable delays with gains that are one.

    As no gain can shrink, what is left weighs the rows as it is.
    """
    rows, gains = problem.rows, problem.gains
    std = np.where(gains.is_delay, DELAY_STD, np.where(gains.is_imu, PINNED, NEARLY_PINNED))
    scale = loads(rows, problem.expected)
    left = (OFF * scale) ** 2
    for _ in range(TURNS):
        at, deviation = problem.solve(std, left + (LEAST * scale) ** 2)
        left = rows.residual_squares(at)
    return _gains(problem, at, deviation, left)


def fit_imu_rotation(problem: GainProblem, gains: GainEstimate, index: int) -> RotationFit:
    """Return the rotation, or its reverse, of an IMU that explains the forces best.

    How long its readings are is known from gravity, and left as it is: gains that all shrink
    together, this one among them, would explain anything.
    """
    scale = loads(problem.rows, problem.expected)
    place = problem.gains.imu(index)
    free = _free(problem.gains)
    pinned = problem.gains.is_imu.copy()
    pinned[place] = False
    std = np.where(pinned, PINNED, free)
    left = gains.left
    for _ in range(TURNS):
        at, deviation = problem.solve(std, left + (FLOOR * scale) ** 2)
        own = _gains(problem, at, deviation, left)
        turn = fit_rotation(*own.matrix(place), is_scaled=False)
        held = at.copy()
        held[len(problem.mean) :][place] = (turn.sign * turn.rotation - np.eye(3)).ravel()
        # What the others are if the IMU is turned like that.
        theta = np.arange(len(at))[len(problem.mean) :][place]
        spread = deviation @ deviation[theta].T
        gain = np.linalg.solve(spread[theta], held[theta] - at[theta])
        left = problem.rows.residual_squares(at + spread @ gain)
    return turn


def loads(rows: CoordinateRows, expected: FloatArray) -> FloatArray:
    """Return the largest root mean square (n,) of what acts on coordinates of one kind.

    What acts is what is measured, or what unknowns (q,) expect beyond that: a force that nobody
    measured is one all the same.
    """
    names = rows.coordinates
    kinds = np.array([name.split("_")[0] if name.startswith("base/") else "" for name in names])
    squares = np.maximum(rows.target_squares, rows.residual_squares(expected))
    largest = np.array([squares[kinds == kind].max() for kind in kinds])
    mean = np.maximum(largest, LEAST**2 * largest.max())
    return np.sqrt(mean) if mean.any() else np.ones(len(mean))


def _free(gains: GainLayout) -> FloatArray:
    return np.where(gains.is_delay, DELAY_STD, GAIN_STD)


def _gains(
    problem: GainProblem, at: FloatArray, deviation: FloatArray, left: FloatArray
) -> GainEstimate:
    p = len(problem.mean)
    before = problem.rows.residual_squares(problem.expected)
    forces = [name.startswith("base/force") for name in problem.rows.coordinates]
    return GainEstimate(
        problem.gains,
        at[p:],
        deviation[p:] @ deviation[p:].T,
        left,
        float(np.sqrt(before[forces].sum())),
        float(np.sqrt(left[forces].sum())),
    )


# Squared deviations that a delay must explain, and what share of all that there is to explain.
EVIDENCE = 25.0
SHARE = 0.1


def find_late_streams(delays: GainEstimate) -> dict[int, tuple[float, float]]:
    """Return places of the delays that are not zero, and each with its standard deviation, s.

    Delays are known against each other better than by themselves, so that one late stream may
    look like all others early. One after the other those are taken that explain most of the
    estimate, until little of it is left.
    """
    free = np.flatnonzero(delays.sensors.is_delay)
    mean = delays.mean[free]
    precision = np.linalg.inv(delays.covariance[np.ix_(free, free)]).astype(np.float64)
    moment = precision @ mean
    total = left = float(mean @ moment)
    chosen: list[int] = []
    found: dict[int, tuple[float, float]] = {}
    while len(chosen) < len(free):
        costs = {
            place: total - _explained(precision, moment, [*chosen, place])
            for place in range(len(free))
            if place not in chosen
        }
        best = min(costs, key=lambda place: costs[place])
        if left - costs[best] < max(EVIDENCE, SHARE * total):
            break
        chosen.append(best)
        left = costs[best]
        own = np.ix_(chosen, chosen)
        size = np.linalg.solve(precision[own], moment[chosen])
        std = np.sqrt(np.diag(np.linalg.inv(precision[own])))
        found = {
            int(free[place]): (float(one), float(doubt))
            for place, one, doubt in zip(chosen, size, std, strict=True)
        }
    return found


def _explained(precision: FloatArray, moment: FloatArray, places: list[int]) -> float:
    own = np.ix_(places, places)
    return float(moment[places] @ np.linalg.solve(precision[own], moment[places]))
