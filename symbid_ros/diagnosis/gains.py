"""Estimates the sensors' gains and delays under a model with uncertain inertias."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import JOINT_TERMS
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.prior_std import OFFSET_STD
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import COMPONENTS
from symbid_ros.signals.weak_form import INFLATION

# Residuals below this share of the load count as zero. Gains that shrink together with the inertias
# explain any log up to its noise, and such residuals must have no weight.
FLOOR = 0.02
# Rough relative error of the model's loads, for the weights of the first solution.
LOAD_ERROR = 0.3
ITERATIONS = 3
# Prior standard deviations of g and of the elements of A and M, and of delays, s.
GAIN_STD, DELAY_STD = 2.0, 0.1
PINNED = 1e-6  # standard deviation of unknowns that are held at their prior
# Residuals up to this multiple of the smallest ones, at the same scale, count as explained.
EXPLAINED = 2.0
# Residuals below this share of the load are explained too: friction near rest leaves as much.
SMALL_SHARE = 0.1
# Residuals above this share of the load are not explained.
LARGEST_SHARE = 0.25
# Relative deviation of the total mass.
MASS_STD = 2e-3
# Standard deviation of the gains when only delays are estimated.
NEARLY_PINNED = 1e-2
# Residuals below this share of the load are rounding errors.
LEAST = 1e-4
# Friction of a joint whose effort is checked, in multiples of its load.
WIDE = 3.0
# Ratios of readings to efforts that errors of the inertias may cause.
PLAUSIBLE = 0.6, 1.6
# Number of variances at which the evidence is compared.
VARIANCES = 60
# Friction that is not modelled varies as slowly as the motion: so many rows count as one.
UNMODELLED = 10.0


@dataclass(frozen=True)
class GainProblem:
    """Rows of [K, -C] [φ; θ] = y and the prior of the unknowns.

    Attributes
    ----------
    rows : CoordinateRows
        Rows of n coordinates.
    mean, std : (p,) float64
        Prior of the parameters φ.
    gains : GainLayout
        Layout of the r unknowns θ that follow φ.
    links : int or None
        Number of inertial parameters, which come first in φ; None if φ has no others.
    body_std : (p,) float64 or None
        Like ``std``, but values near zero, such as a centre of mass on an axis, may be off by a
        quarter of the link's size. Checks of single joints use it.
    """

    rows: CoordinateRows
    mean: FloatArray
    std: FloatArray
    gains: GainLayout
    links: int | None = None
    body_std: FloatArray | None = None

    @classmethod
    def of(
        cls,
        rows: CoordinateRows,
        parameters: ParameterSet,
        std: FloatArray,
        gains: GainLayout,
        body_std: FloatArray,
    ) -> "GainProblem":
        """Return the problem for given deviations of the inertias (p,) and small drive loads."""
        mean, links = parameters.values, len(std)
        std = np.concatenate([std, np.zeros(len(mean) - len(std))])
        first = parameters.model.dof - len(parameters.model.joints)
        load = loads(rows, np.append(mean, np.zeros(len(gains))))[first:]
        std[parameters.sensor_offsets] = OFFSET_STD * len(parameters.model.wrist_sensors)
        joints = parameters.joints.tolist()
        for term, columns in parameters.term_columns.items():
            for joint, column in zip(joints, range(columns.start, columns.stop), strict=True):
                size = np.sqrt(rows.column_squares(first + joint, column))
                share = JOINT_TERMS[term].load_share
                std[column] = share * load[joint] / max(size, 1e-9) + PINNED
        return cls(rows, mean, std, gains, links, np.append(body_std, std[links:]))

    @property
    def for_joints(self) -> "GainProblem":
        """The problem with the deviations for checks of single joints."""
        return self if self.body_std is None else replace(self, std=self.body_std)

    @property
    def expected(self) -> FloatArray:
        """(p + r,) prior mean: the model's parameters and gains of one."""
        return np.append(self.mean, np.zeros(len(self.gains)))

    def solve(
        self, std: FloatArray, left: FloatArray, mass_std: float = np.inf
    ) -> tuple[FloatArray, FloatArray]:
        """Return the most probable unknowns (p + r,) and L of their covariance L Lᵀ.

        Parameters
        ----------
        std : (r,) float64
            Prior deviations of the gains and delays.
        left : (n,) float64
            Mean square residual of each coordinate.
        mass_std : float
            Relative deviation of the total mass; infinite: that of independent links.
        """
        scale = np.append(self.std, std)
        mean, q = self.expected, len(scale)
        rows = self.rows.whitened(np.sqrt(INFLATION * left))
        square = stacked_factor(
            np.column_stack([rows[:, :-1] * scale, rows[:, -1] - rows[:, :-1] @ mean]),
            np.vstack([np.eye(q, q + 1), self._total_mass(q + 1) / mass_std]),
        )
        R = square[:q, :q]
        deviation: FloatArray = scale[:, None] * solve_triangular(R, np.eye(q))
        return mean + scale * solve_triangular(R, square[:q, q]), deviation

    @property
    def _masses(self) -> slice:
        return slice(0, len(self.mean) if self.links is None else self.links, 10)

    def _total_mass(self, width: int) -> FloatArray:
        """Return the row of the relative error of the total mass, for scaled unknowns."""
        row = np.zeros(width)
        row[self._masses] = self.std[self._masses] / self._model_mass
        return row

    def mass_ratio(self, unknowns: FloatArray) -> float:
        """Return the total mass that the unknowns (p + r,) imply over the model's."""
        return max(abs(float(np.sum(unknowns[self._masses]))) / self._model_mass, LEAST)

    @property
    def _model_mass(self) -> float:
        return max(float(np.sum(self.mean[self._masses])), LEAST)


@dataclass(frozen=True)
class GainEstimate:
    """Most probable gains and delays.

    Attributes
    ----------
    sensors : GainLayout
        Layout of the unknowns.
    mean : (r,) float64
        Each unknown minus its nominal value.
    covariance : (r, r) float64
        Covariance of the unknowns, marginalized over the inertias.
    left : (n,) float64
        Mean square residual of each coordinate.
    before, after : float
        Root mean square residual of the base's force, N, with all gains at one and with the
        estimated gains.
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
        """Return the delay of a sensor and its standard deviation, s."""
        return float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))

    def effort(self, index: int) -> tuple[float, float]:
        """Return g of a driven joint, and the relative standard deviation of the ratio 1/g.

        That is also the deviation by which g differs from one.
        """
        place = self.sensors.efforts.start + index
        return 1 + float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))


def estimate_gains(problem: GainProblem) -> GainEstimate:
    """Return the most probable gains of wrenches and efforts, with trusted IMUs.

    Rows are weighted by the residual of their coordinate, at least `FLOOR` of the load. The first
    residuals are those with gains of one, so that inconsistent rows get little weight. The gains of
    efforts are the inverse ratios of `effort_scale`, with the same significance.
    """
    rows, gains = problem.rows, problem.gains
    scale = loads(rows, problem.expected)
    pinned = np.full(len(gains), PINNED)
    at, _ = problem.solve(pinned, (LOAD_ERROR * scale) ** 2)
    left = rows.residual_squares(at)
    free = np.where(gains.is_imu | gains.is_encoder, PINNED, _prior_std(gains))
    floor = (FLOOR * scale) ** 2
    solutions = []
    for mass_std in (np.inf, MASS_STD):
        residual = left
        for _ in range(ITERATIONS):
            at, deviation = problem.solve(free, residual + floor, mass_std)
            residual = rows.residual_squares(at)
        solutions.append((at, deviation, residual))
    # Gains and inertias that shrink together shrink the readings' noise too, so residuals do not
    # tell their common scale. The model does, if its total mass explains the log as well.
    shrunk = problem.mass_ratio(solutions[0][0])
    anchored = solutions[1][2]
    is_explained = anchored <= EXPLAINED**2 * solutions[0][2] / shrunk**2
    is_explained |= anchored <= (SMALL_SHARE * scale) ** 2
    is_explained &= anchored <= (LARGEST_SHARE * scale) ** 2
    at, deviation, left = solutions[int(np.all(is_explained))]
    found = estimate_of(problem, at, deviation, left)
    for index in range(len(gains.driven)):
        ratio, std = effort_scale(problem, found, index)
        place = gains.efforts.start + index
        found.mean[place] = 1 / ratio - 1
        found.covariance[place], found.covariance[:, place] = 0.0, 0.0
        found.covariance[place, place] = (std / ratio) ** 2
    return found


def estimate_delays(problem: GainProblem) -> GainEstimate:
    """Return the most probable delays with gains of one.

    The gains cannot shrink, so the residuals weight the rows without a floor.
    """
    rows, gains = problem.rows, problem.gains
    pinned = gains.is_imu | gains.is_encoder
    std = np.where(gains.is_delay, DELAY_STD, np.where(pinned, PINNED, NEARLY_PINNED))
    scale = loads(rows, problem.expected)
    left = (LOAD_ERROR * scale) ** 2
    for _ in range(ITERATIONS):
        at, deviation = problem.solve(std, left + (LEAST * scale) ** 2)
        left = rows.residual_squares(at)
    return estimate_of(problem, at, deviation, left)


def fit_imu_rotation(problem: GainProblem, gains: GainEstimate, index: int) -> RotationFit:
    """Return the rotation, or its reverse, of an IMU that explains the forces best.

    The scale of its readings is known from gravity and is held, because gains that all shrink
    together explain any log.
    """
    scale = loads(problem.rows, problem.expected)
    place = problem.gains.imu(index)
    free = _prior_std(problem.gains)
    pinned = problem.gains.is_imu | problem.gains.is_encoder
    pinned[place] = False
    std = np.where(pinned, PINNED, free)
    left = gains.left
    for _ in range(ITERATIONS):
        at, deviation = problem.solve(std, left + (FLOOR * scale) ** 2)
        own = estimate_of(problem, at, deviation, left)
        turn = fit_rotation(*own.matrix(place), is_scaled=False)
        held = at.copy()
        held[len(problem.mean) :][place] = (turn.sign * turn.rotation - np.eye(3)).ravel()
        # Condition the other unknowns on this rotation of the IMU.
        theta = np.arange(len(at))[len(problem.mean) :][place]
        spread = deviation @ deviation[theta].T
        gain = np.linalg.solve(spread[theta], held[theta] - at[theta])
        left = problem.rows.residual_squares(at + spread @ gain)
    return turn


def effort_scale(problem: GainProblem, gains: GainEstimate, index: int) -> tuple[float, float]:
    """Return the ratio of a driven joint's efforts to those expected, and its deviation.

    The gains of `estimate_gains` multiply friction and noise in the readings as well, so a joint
    with more friction than load appears to have no gain. Here the readings are the load that the
    inertias imply times the ratio, plus friction, armature and offset of any size. Only the load
    determines the ratio.

    Parameters
    ----------
    problem : GainProblem
    gains : GainEstimate
        Estimate from the same rows; its gains of wrenches are used.
    index : int
        Index of the driven joint.
    """
    layout, rows, p = problem.gains, problem.rows, len(problem.mean)
    links = p if problem.links is None else problem.links
    first = sum(name.startswith("base/") for name in rows.coordinates)
    factor = rows.factor(first + layout.driven[index])
    own = p + layout.efforts.start + index
    read = -factor[:, own]
    size = np.sqrt(float(read @ read) / max(rows.samples, 1))
    # Remove the readings, their delay and the drives from the left side: the load remains.
    unknowns = np.append(problem.mean, gains.mean)
    unknowns[links:p] = unknowns[p + layout.effort_delay] = 0.0
    unknowns[own] = -1.0
    load = factor[:, :-1] @ unknowns - factor[:, -1]
    if np.sqrt(float(load @ load) / rows.samples) <= LEAST * size or size == 0.0:
        return 1.0, GAIN_STD
    inertias = factor[:, :links] * problem.for_joints.std[:links]
    drives = factor[:, links:p]
    norm = np.sqrt(np.sum(drives**2, axis=0) / rows.samples)
    drives = drives[:, norm > 0] * (WIDE * size / norm[norm > 0])
    ratio, left = 1.0, (LOAD_ERROR * size) ** 2
    for _ in range(2 * ITERATIONS):
        columns = np.column_stack([load, inertias * np.clip(abs(ratio), LEAST, 1 / LEAST), drives])
        weight = 1 / (UNMODELLED * (left + (FLOOR * size) ** 2))
        information = weight * columns.T @ columns + np.eye(columns.shape[1])
        information[0, 0] += LEAST**2 * weight * float(load @ load) - 1
        at = np.linalg.solve(information, weight * columns.T @ read)
        ratio = float(at[0])
        left = float(np.sum((read - columns @ at) ** 2)) / rows.samples
    # Friction near rest leaves residuals in which so small a load cannot be seen.
    if max(abs(ratio), 1.0) * np.sqrt(float(load @ load) / rows.samples) < SMALL_SHARE * size:
        return 1.0, GAIN_STD
    std = float(np.sqrt(np.linalg.inv(information)[0, 0]))
    if layout.wrench_frames or PLAUSIBLE[0] < ratio < PLAUSIBLE[1]:
        return _away_from_zero(ratio), std
    # Without measured forces an uncertain load attenuates the ratio. Likelihoods tell whether
    # efforts of the right scale explain the readings as well.
    found, right = (
        log_likelihoods(
            read - one * load,
            np.column_stack([abs(one) * inertias, drives]),
            UNMODELLED * (FLOOR * size) ** 2,
            rows.samples / UNMODELLED,
        )
        for one in (ratio, 1.0)
    )
    gained = min(np.subtract(found, right))
    deviations = float(np.sqrt(max(2 * gained, 0.0)))
    return _away_from_zero(ratio), max(std, abs(ratio - 1) / max(deviations, 1.0))


def log_likelihoods(
    target: FloatArray, columns: FloatArray, least: float, independent: float
) -> tuple[float, float]:
    """Return two log likelihoods of a target whose noise variance is not known, up to a constant.

    The first is the evidence, in which the unknowns are marginalised, the second that of their most
    probable values. A large ratio explains more by its wide columns, which the evidence punishes. A
    ratio near zero has narrow columns, which the evidence rewards even if the readings agree with a
    ratio of one, as those of a body do whose centre of mass lies on the axis unlike the model's.

    Parameters
    ----------
    target : (w,) float64
        Factor of the target.
    columns : (w, q) float64
        Factor of the columns of q unknowns with zero mean and a deviation of one.
    least : float
        Smallest variance of the noise.
    independent : float
        Number of independent rows.
    """
    values, V = np.linalg.eigh(columns.T @ columns)
    fit = (V.T @ (columns.T @ target)) ** 2
    square = float(target @ target)
    weight = np.geomspace(1 / max(square, least), 1 / least, VARIANCES)[:, None]
    ratio = weight * np.maximum(values, 0.0)
    left = weight[:, 0] * square - np.sum(weight**2 * fit / (1 + ratio), axis=1)
    best = left - independent * np.log(weight[:, 0])
    evidence = best + np.sum(np.log1p(ratio), axis=1)
    return float(-0.5 * evidence.min()), float(-0.5 * best.min())


def _away_from_zero(ratio: float) -> float:
    return float(np.copysign(max(abs(ratio), LEAST), ratio))


def loads(rows: CoordinateRows, expected: FloatArray) -> FloatArray:
    """Return the largest root mean square load (n,) among coordinates of the same kind.

    Joints are of two kinds, revolute and prismatic. The load is the measured one, or the one that
    the unknowns (q,) imply if that is larger, because a force may lack a sensor.
    """
    kinds = np.array(
        [
            name.rpartition("_")[0] if name.rpartition("/")[2] in COMPONENTS else unit
            for name, unit in zip(rows.coordinates, rows.units, strict=True)
        ]
    )
    squares = np.maximum(rows.target_squares, rows.residual_squares(expected))
    largest = np.array([squares[kinds == kind].max() for kind in kinds])
    mean = np.maximum(largest, LEAST**2 * largest.max())
    return np.sqrt(mean) if mean.any() else np.ones(len(mean))


def _prior_std(gains: GainLayout) -> FloatArray:
    return np.where(gains.is_delay, DELAY_STD, GAIN_STD)


def estimate_of(
    problem: GainProblem, at: FloatArray, deviation: FloatArray, left: FloatArray
) -> GainEstimate:
    """Return an estimate from the unknowns (p + r,), L of their covariance, and the residuals."""
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


# A delay or offset must explain this many squared deviations, and this share of the total.
EVIDENCE = 25.0
SHARE = 0.1


def find_late_streams(delays: GainEstimate) -> dict[int, tuple[float, float]]:
    """Return the indices of non-zero delays, each with its delay and standard deviation, s.

    Relative delays are known better than absolute ones, so one late stream may look like all
    others early.
    """
    return select_nonzero(delays, delays.sensors.is_delay)


def select_nonzero(estimate: GainEstimate, among: BoolArray) -> dict[int, tuple[float, float]]:
    """Return the unknowns that differ from zero, each with its value and standard deviation.

    They are selected greedily, the one that explains most first, until little of the estimate is
    left.

    Parameters
    ----------
    estimate : GainEstimate
    among : (r,) bool
        The unknowns to select from, which have the same unit.
    """
    free = np.flatnonzero(among)
    mean = estimate.mean[free]
    precision = np.linalg.inv(estimate.covariance[np.ix_(free, free)]).astype(np.float64)
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
            int(free[place]): (float(one), float(error))
            for place, one, error in zip(chosen, size, std, strict=True)
        }
    return found


def _explained(precision: FloatArray, moment: FloatArray, places: list[int]) -> float:
    own = np.ix_(places, places)
    return float(moment[places] @ np.linalg.solve(precision[own], moment[places]))
