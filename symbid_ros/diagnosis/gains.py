"""Estimates the sensors' gains and delays under a model with uncertain inertias."""

from dataclasses import replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.diagnosis.gain_problem import (
    DELAY_STD,
    GAIN_STD,
    ITERATIONS,
    LEAST,
    LOAD_ERROR,
    PINNED,
    SMALL_SHARE,
    GainEstimate,
    GainProblem,
    estimate_of,
    loads,
)
from symbid_ros.diagnosis.gain_rows import GainLayout
from symbid_ros.diagnosis.joint_efforts import PLAUSIBLE, effort_scale, load_share
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation

# Residuals up to this multiple of the smallest ones, at the same scale, count as explained.
EXPLAINED = 2.0
# Residuals above this share of the load, apart from noise, are not explained.
LARGEST_SHARE = 0.25
# Relative deviation of the total mass.
MASS_STD = 2e-3
# Standard deviation of the gains when only delays are estimated.
NEARLY_PINNED = 1e-2
# A delay or offset must explain this many squared deviations, and this share of the total.
EVIDENCE = 25.0
SHARE = 0.1
# A factor of an effort follows from its load if that explains this share of what friction, armature
# and offset leave over. On real logs, loads explain .19 and more of efforts in other units, and .04
# or less where the load hides: of a vertical first joint, or a pendulum that is driven along.
LEAST_SHOWN = 0.15
# Steps in which the delay of efforts is found, until one is this small, s.
SHIFTS, SMALL_STEP = 10, 5e-4


def estimate_gains(problem: GainProblem) -> GainEstimate:
    """Return the most probable gains of wrenches and efforts, with trusted IMUs.

    Rows are weighted by the residual of their coordinate, at least `FLOOR` of the load. The first
    residuals are those with gains of one, so that inconsistent rows get little weight. The gains of
    efforts are the inverse ratios of `effort_scale`, with the same significance. A ratio that
    differs from one may only say that the load is not in the effort; then it is hidden.
    """
    rows, gains = problem.rows, problem.gains
    scale = loads(rows, problem.expected)
    pinned = np.full(len(gains), PINNED)
    at, _ = problem.solve(pinned, (LOAD_ERROR * scale) ** 2)
    left = rows.residual_squares(at)
    free = np.where(gains.is_imu | gains.is_encoder, PINNED, _prior_std(gains))
    floor, solutions = problem.floor, []
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
    is_explained &= anchored <= (LARGEST_SHARE * scale) ** 2 + problem.noise
    at, deviation, left = solutions[int(np.all(is_explained))]
    found = estimate_of(problem, at, deviation, left)
    hidden = dict[int, float]()
    for index in range(len(gains.driven)):
        ratio, std = effort_scale(problem, found, index)
        if not PLAUSIBLE[0] < ratio < PLAUSIBLE[1]:
            share = load_share(problem, found, index)
            hidden |= {index: share} if share < LEAST_SHOWN else {}
        place = gains.efforts.start + index
        found.mean[place] = 1 / ratio - 1
        found.covariance[place], found.covariance[:, place] = 0.0, 0.0
        found.covariance[place, place] = (std / ratio) ** 2
    return replace(found, hidden_loads=hidden, mass_ratio=_mass_ratio(problem, pinned))


def _mass_ratio(problem: GainProblem, pinned: FloatArray) -> float:
    """Return the total mass that explains the log with all gains at one, over the model's."""
    rows = problem.rows
    left = (LOAD_ERROR * loads(rows, problem.expected)) ** 2
    for _ in range(ITERATIONS):
        at, _ = problem.solve(pinned, left + problem.floor)
        left = rows.residual_squares(at)
    return problem.mass_ratio(at)


def estimate_delays(problem: GainProblem) -> GainEstimate:
    """Return the most probable delays with gains of one.

    The columns of the delays are derivatives. Friction makes efforts jump, so their delay is found
    in steps: the efforts are shifted by each step before the next one.
    """
    delays, shift = _remaining_delays(problem), 0.0
    place = problem.gains.effort_delay
    for _ in range(SHIFTS):
        step, _ = find_late_streams(delays).get(place, (0.0, 0.0))
        if problem.lagged is None or abs(step) < SMALL_STEP:
            break
        shift += step
        delays = _remaining_delays(problem.with_later_efforts(shift))
    delays.mean[place] += shift
    return delays


def _remaining_delays(problem: GainProblem) -> GainEstimate:
    """Return the delays of a problem that are small.

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
    place = problem.gains.imu(index)
    free = _prior_std(problem.gains)
    pinned = problem.gains.is_imu | problem.gains.is_encoder
    pinned[place] = False
    std = np.where(pinned, PINNED, free)
    floor, left = problem.floor, gains.left
    for _ in range(ITERATIONS):
        at, deviation = problem.solve(std, left + floor)
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


def _prior_std(gains: GainLayout) -> FloatArray:
    return np.where(gains.is_delay, DELAY_STD, GAIN_STD)


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
