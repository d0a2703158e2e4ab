"""Scale and delay of the efforts of single joints, with friction of any size."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.diagnosis.effort_lags import LAGS, STEP, LaggedRows
from symbid_ros.diagnosis.gain_problem import (
    DELAY_STD,
    FLOOR,
    GAIN_STD,
    ITERATIONS,
    LEAST,
    LOAD_ERROR,
    SMALL_SHARE,
    UNMODELLED,
    GainEstimate,
    GainProblem,
)

# Friction of a joint whose effort is checked, in multiples of its load.
WIDE = 3.0
# Ratios of readings to efforts that errors of the inertias may cause.
PLAUSIBLE = 0.6, 1.6
# Largest share of noise in the power of a load, apart from what inertias and friction explain, that
# still tells a ratio.
MOST_NOISE = 0.5
# Identification is insensitive to smaller delays, s. A delay is certain at so many deviations, and
# it must explain this share of the squares of a joint's residuals. Friction that is not modelled
# explains a fifth of them on simulated arms; on public logs no delay is both.
LARGEST_DELAY, CERTAIN, MOSTLY = 3e-3, 5.0, 0.5
# A delay is known with this deviation, s.
KNOWN = 2 * LARGEST_DELAY
# Rows of other instants reach so far, s. A delay that reaches this bound must be known: on public
# logs, friction that is not modelled leads there with a deviation of 10 ms and more.
FARTHEST = float(LAGS[-1]) - STEP
# Steps in which a delay is found, until one is this small, s.
DELAY_STEPS, SMALL_STEP = 10, 5e-4
# Number of variances at which the evidence is compared.
VARIANCES = 60


def effort_scale(problem: GainProblem, gains: GainEstimate, index: int) -> tuple[float, float]:
    """Return the ratio of a driven joint's efforts to those expected, and its deviation.

    The gains of `estimate_gains` multiply friction and noise in the readings as well, so a joint
    with more friction than load appears to have no gain. Here the readings are the load that the
    inertias imply times the ratio, plus friction, armature and offset of any size. Only the load
    determines the ratio. White noise of the wrenches in the load would attenuate the ratio. Its
    power is subtracted, and the deviation includes the size of this correction.

    Parameters
    ----------
    problem : GainProblem
    gains : GainEstimate
        Estimate from the same rows; its gains of wrenches are used.
    index : int
        Index of the driven joint.
    """
    layout, rows = problem.gains, problem.rows
    factor, size = _rows_of(problem, index)
    read, load = _effort_and_load(problem, gains, index)
    if np.sqrt(float(load @ load) / rows.samples) <= LEAST * size or size == 0.0:
        return 1.0, GAIN_STD
    inertias, drives = _scaled_columns(problem, factor, size)
    noise = rows.samples * _load_noise(problem, gains, index)
    ratio, left = 1.0, (LOAD_ERROR * size) ** 2
    for _ in range(2 * ITERATIONS):
        columns = np.column_stack([load, inertias * np.clip(abs(ratio), LEAST, 1 / LEAST), drives])
        weight = 1 / (UNMODELLED * (left + (FLOOR * size) ** 2))
        information = weight * columns.T @ columns + np.eye(columns.shape[1])
        information[0, 0] += LEAST**2 * weight * float(load @ load) - 1
        # Noise in the load makes the ratio too small, so its power does not count as information.
        apparent = 1 / float(np.linalg.inv(information)[0, 0])
        information[0, 0] -= min(weight * noise, MOST_NOISE * apparent)
        at = np.linalg.solve(information, weight * columns.T @ read)
        ratio = float(at[0])
        left = float(np.sum((read - columns @ at) ** 2)) / rows.samples
    # Friction near rest leaves residuals in which so small a load cannot be seen.
    if max(abs(ratio), 1.0) * np.sqrt(float(load @ load) / rows.samples) < SMALL_SHARE * size:
        return 1.0, GAIN_STD
    attenuation = weight * noise / apparent
    if attenuation > MOST_NOISE:
        return 1.0, GAIN_STD
    std = np.sqrt(apparent) * float(np.linalg.inv(information)[0, 0])
    std = float(np.hypot(std, attenuation * ratio))
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


def load_share(problem: GainProblem, gains: GainEstimate, index: int) -> float:
    """Return the share of a driven joint's effort that its load explains.

    It is that of the squares which friction, armature and an offset of any size leave over.
    """
    factor, size = _rows_of(problem, index)
    if size == 0.0:
        return 0.0
    read, load = _effort_and_load(problem, gains, index)
    _, drives = _scaled_columns(problem, factor, size)
    both = np.column_stack([read, load])
    left = both - drives @ np.linalg.lstsq(drives, both, rcond=None)[0]
    # Readings and load may have different units.
    if np.any(np.linalg.norm(left, axis=0) <= LEAST * np.linalg.norm(both, axis=0)):
        return 0.0
    squares = left.T @ left
    return float(squares[0, 1] ** 2 / (squares[0, 0] * squares[1, 1]))


def effort_delay_error(problem: GainProblem) -> float:
    """Return the standard deviation of the delay of all efforts, from single joints, s.

    Friction that lags behind the motion looks like a delay, but not like the same one at every
    joint. If one joint tells most, nothing shows that the others agree.
    """
    layout = problem.gains
    found = []
    for index in range(len(layout.driven)):
        factor, size = _rows_of(problem, index)
        if size > 0.0:
            step, std, _ = _delay_in(problem, factor, size)
            found.append((step, std**2))
    if len(found) < min(len(layout.driven), 2):  # the others rest
        return DELAY_STD
    delay, variance = np.array(found).T
    share = (1 / variance) / np.sum(1 / variance)
    others = 1 / np.sum(share**2) - 1
    spread = share @ (delay - share @ delay) ** 2 / max(others, LEAST)
    return float(np.sqrt(1 / np.sum(1 / variance) + spread))


def late_efforts(
    problem: GainProblem, common: float, moves: BoolArray
) -> dict[str, tuple[float, float]]:
    """Return the driven joints whose efforts alone are late, each with its delay and deviation, s.

    A delay of ``FARTHEST`` may be larger.

    Friction that is not modelled looks like a delay too. It explains a small part of a joint's
    residuals; a delay explains most of them. The delay of at least one other joint must be known.

    Parameters
    ----------
    problem : GainProblem
        With the efforts as they were read.
    common : float
        Delay of all efforts, s.
    moves : (d,) bool
        Driven joints that move enough. Static friction of the others takes any value.
    """
    if problem.lagged is None:
        return {}
    late, usual = {}, False
    for index in np.flatnonzero(moves).tolist():
        delay, std, explained = _joint_delay(problem, problem.lagged, index, common)
        if abs(delay) == FARTHEST and std > KNOWN:
            continue
        apart = abs(delay - common)
        if apart > max(CERTAIN * std, LARGEST_DELAY) and explained > MOSTLY:
            late[problem.gains.joint_names[index]] = delay, std
        else:
            usual = usual or std < KNOWN
    return late if usual else {}


def _joint_delay(
    problem: GainProblem, lagged: LaggedRows, index: int, start: float
) -> tuple[float, float, float]:
    """Return the delay of a joint's effort, its deviation, s, and the share of squares it explains.

    Coulomb friction makes efforts jump, so the delay is found in steps from ``start``.
    """
    coordinate, delay = _coordinate(problem, index), start
    _, size = _rows_of(problem, index)
    if size == 0.0:
        return start, DELAY_STD, 0.0
    first = lagged.shifted_factor(coordinate, start)
    _, _, before = _delay_in(problem, first, size, std=LEAST * DELAY_STD)
    for _ in range(DELAY_STEPS):
        factor = lagged.shifted_factor(coordinate, delay)
        step, std, left = _delay_in(problem, factor, size)
        delay = float(np.clip(delay + step, -FARTHEST, FARTHEST))
        if abs(step) < SMALL_STEP:
            break
    return delay, std, 1 - left / max(before, np.finfo(float).tiny)


def _delay_in(
    problem: GainProblem, factor: FloatArray, size: float, std: float = DELAY_STD
) -> tuple[float, float, float]:
    """Return the delay in rows of one joint, its deviation, s, and the mean square that remains.

    ``std`` is the prior deviation of the delay, s.
    """
    p = len(problem.mean)
    late = factor[:, p + problem.gains.effort_delay] * std
    target = factor[:, -1] - factor[:, :p] @ problem.mean
    columns = np.column_stack([late, *_scaled_columns(problem, factor, size)])
    left = (LOAD_ERROR * size) ** 2
    for _ in range(2 * ITERATIONS):
        weight = 1 / (UNMODELLED * (left + (LEAST * size) ** 2))
        information = weight * columns.T @ columns + np.eye(columns.shape[1])
        at = np.linalg.solve(information, weight * columns.T @ target)
        left = float(np.sum((target - columns @ at) ** 2)) / problem.rows.samples
    deviation = std * float(np.sqrt(np.linalg.inv(information)[0, 0]))
    return std * float(at[0]), deviation, left


def _coordinate(problem: GainProblem, index: int) -> int:
    """Return the coordinate of a driven joint."""
    first = sum(name.startswith("base/") for name in problem.rows.coordinates)
    return first + problem.gains.driven[index]


def _rows_of(problem: GainProblem, index: int) -> tuple[FloatArray, float]:
    """Return the factor of a driven joint's rows, and its root mean square reading."""
    layout, rows = problem.gains, problem.rows
    factor = rows.factor(_coordinate(problem, index))
    read = factor[:, len(problem.mean) + layout.efforts.start + index]
    return factor, float(np.sqrt(float(read @ read) / max(rows.samples, 1)))


def _effort_and_load(
    problem: GainProblem, gains: GainEstimate, index: int
) -> tuple[FloatArray, FloatArray]:
    """Return the factors (w,) of a driven joint's readings and of the load that is expected."""
    layout, p = problem.gains, len(problem.mean)
    factor, _ = _rows_of(problem, index)
    own = p + layout.efforts.start + index
    # Remove the readings, their delay and the drives from the left side: the load remains.
    unknowns = np.append(problem.mean, gains.mean)
    unknowns[problem.number_of_inertias : p] = unknowns[p + layout.effort_delay] = 0.0
    unknowns[own] = -1.0
    return -factor[:, own], factor[:, :-1] @ unknowns - factor[:, -1]


def _load_noise(problem: GainProblem, gains: GainEstimate, index: int) -> float:
    """Return the mean square of a driven joint's load by white noise of the wrenches."""
    layout = problem.gains
    if problem.load_noise is None:
        return 0.0
    matrices = [gains.matrix(layout.wrench(place))[0] for place in range(len(layout.wrench_frames))]
    scale = np.array([np.mean(np.sum(A**2, axis=1)) for A in matrices])
    return float(scale @ problem.load_noise[:, layout.driven[index]])


def _scaled_columns(
    problem: GainProblem, factor: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Return columns of inertias and of drives times their deviations; ``size`` is the load's."""
    links, p = problem.number_of_inertias, len(problem.mean)
    drives = factor[:, links:p]
    norm = np.sqrt(np.sum(drives**2, axis=0) / problem.rows.samples)
    wide = drives[:, norm > 0] * (WIDE * size / norm[norm > 0])
    inertias = factor[:, :links] * problem.std[:links]
    return inertias[:, np.any(inertias != 0, axis=0)], wide


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
