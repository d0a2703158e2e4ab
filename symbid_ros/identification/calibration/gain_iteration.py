"""Identifies drive gains together with all parameters, from one pass over a log.

The log is identified as if the gains were known: with the best window length and the joint terms
that it asks for. Rows linearised about that solution give better gains, and so on. A linearisation
about the model file instead errs on a robot whose friction or inertias the file does not know.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.estimation.effort_columns import EffortColumns
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements, stacked
from symbid_ros.identification.calibration.drive_gains import InitialFactors
from symbid_ros.identification.calibration.extended_problem import (
    ASSUMED_STD,
    NOISY_CHANNELS,
    error_layout,
    is_undetermined,
    open_scale_remark,
    padded,
)
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset, observe
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.sampled_rows import SampledRows
from symbid_ros.signals.sensor_errors import DRIVE_GAIN, SensorErrors
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.signals.weak_form import equation_rows
from symbid_ros.signals.window_averages import Average, AveragingRows

# Identifications with given gains, and linearised steps after each.
ROUNDS, STEPS = 3, 8
# Deviation of the terms of a drive with an unknown gain at least, in their values: their prior,
# which suits the size of the efforts, does not determine the gain.
FREE = 10.0
# Largest change of a gain's logarithm in one step, and the one at which steps stop.
LARGEST_STEP, CONVERGED = 1.0, 1e-3


@dataclass(frozen=True)
class EffortRows(AveragingRows):
    """Builds rows K φ - u k = w, in which the efforts u of ``joints`` (r,) are the last columns."""

    parameters: ParameterSet
    joints: IntArray

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        effort = self._effort(readings)
        start = 0
        for part in equation_rows(self.parameters)(self._without(readings)):
            stop = start + len(part.stamp)
            K = self._extended(part.rows.K, effort[start:stop])
            yield replace(part, rows=Rows(K, part.rows.y))
            start = stop

    def averages(self, readings: SensorSamples, weights: Sequence[csr_array]) -> list[Average]:
        """Return averages over windows with weights (W, N) each."""
        effort = self._effort(readings)
        found = equation_rows(self.parameters).averages(self._without(readings), weights)
        return [
            replace(one, K=self._extended(one.K, weight @ effort))
            for one, weight in zip(found, weights, strict=True)
        ]

    def _effort(self, readings: SensorSamples) -> FloatArray:
        """Return the readings (N, r), zero where there are none and rows are invalid."""
        return np.nan_to_num(readings.effort[:, self.joints])

    def _without(self, readings: SensorSamples) -> SensorSamples:
        effort = readings.effort.copy()
        effort[:, self.joints] *= 0.0  # a NaN stays, and its row is invalid
        return replace(readings, effort=effort)

    def _extended(self, K: FloatArray, effort: FloatArray) -> FloatArray:
        columns = np.zeros((*K.shape[:2], len(self.joints)))
        rows = 6 * self.parameters.model.floating + self.joints
        columns[:, rows, range(len(self.joints))] = -effort
        return np.concatenate([K, columns], axis=2)


def identify_gains(
    problem: Problem,
    dataset: Dataset,
    factors: InitialFactors,
    solve: Callable[[Problem], SolvedProblem],
) -> Problem:
    """Return a problem with drive gains as unknowns, linearised about the best estimate.

    The given problem has no gains, and its observations are not used. ``factors`` are first guesses
    of the gains. ``solve`` solves a problem whose gains are known, and chooses its joint terms if
    they are candidates.
    """
    parameters = problem.parameters
    segment = next(iter(dataset.segments))
    errors = SensorErrors.of(
        (DRIVE_GAIN,), parameters.model, segment.wrench_frames, segment.imu_frames, factors.joints
    )
    joints = np.array(errors.gained_joints)
    columns = EffortColumns(error_layout(parameters, errors), len(joints))
    raw = observe(
        dataset.segments,
        EffortRows(parameters, joints),
        columns.layout,
        [one.window for one in dataset.observations],
        NOISY_CHANNELS,
        candidates=parameters.candidates,
    )
    unknowns = _Gains(errors.names, factors.values[joints], factors.weights, factors.spread)
    gains = unknowns.guess
    for turn in range(ROUNDS):
        known = tuple(columns.converted(one, gains) for one in raw)
        solved = solve(replace(problem, observations=known))
        if turn == 0:
            phi = _whole(problem, solved, solved.posterior.mean)
            rows = columns.linearised(_rows_of(solved, raw), phi, gains)
            if factors.tell_scale:
                unknowns = unknowns.with_scale(problem, rows, phi)
        phi, gains = _improved(solved, columns, raw, unknowns, gains, joints=factors.joints)
    whole = _whole(problem, solved, phi)
    found = replace(
        unknowns.added(_with_free_terms(problem, whole, factors.joints), gains),
        observations=tuple(columns.linearised(one, whole, gains) for one in raw),
        sensor_units=errors.units,
        calibrated_rows=CalibratingRows(parameters, errors, LinearizationPoint(whole, gains)),
        remarks=(open_scale_remark(parameters, dataset),) if unknowns.holds_scale else (),
    )
    choice = solved.problem.choice
    if choice is None:
        return found
    if choice.deviations is not None:
        choice = replace(choice, deviations=np.pad(choice.deviations, ((0, len(gains)), (0, 0))))
    return replace(choice.applied(found), choice=choice)


@dataclass(frozen=True)
class _Gains:
    """What is known of the gains before the data.

    Attributes
    ----------
    names : tuple of str
    guess : (r,) float64
        First guesses.
    weights : (r,) float64
        Share of each in the common scale.
    spread : float
        Standard deviation of each, relative to its guess.
    holds_scale : bool
        Whether the log leaves the common scale open, so that it is that of the first guesses.
    """

    names: tuple[str, ...]
    guess: FloatArray
    weights: FloatArray
    spread: float
    holds_scale: bool = False

    def added(self, problem: Problem, gains: FloatArray) -> Problem:
        """Return a problem with the gains as unknowns, linearised about ``gains`` (r,).

        The prior is one of the logarithms.
        """
        change = np.log(gains / self.guess)
        std = self.spread * np.abs(gains)
        measurements = padded(problem.pseudo_measurements, len(gains))
        if self.holds_scale:
            row = self._scale(len(problem.parameters), gains)[None] / ASSUMED_STD
            target = (1 - self.weights @ change) / ASSUMED_STD
            measurements = stacked(measurements, PseudoMeasurements(row, np.array([target])))
        return replace(
            problem,
            prior=problem.prior.extended(self.names, gains * (1 - change), std),
            pseudo_measurements=measurements,
        )

    def with_scale(self, problem: Problem, rows: Observations, phi: FloatArray) -> "_Gains":
        """Return the same, with the common scale held if a log leaves it open.

        The problem has the columns of all candidates: terms at a value of the model file, which may
        be a placeholder, do not determine the scale. Rows are linearised about the first guesses
        and the parameters ``phi`` (p,) with these.
        """
        count = len(phi)
        some = self.added(problem, self.guess)
        # Nor does a narrow prior of links that the model file underestimates.
        wide = np.maximum(1.0, np.abs(np.append(phi, self.guess)) / some.prior.std)
        is_open = is_undetermined(
            self._scale(count, self.guess),
            rows,
            some.prior.widened(wide),
            some.pseudo_measurements,
            count,
        )
        return replace(self, holds_scale=is_open)

    def _scale(self, count: int, gains: FloatArray) -> FloatArray:
        """Return the row (p + r,) whose value is the gains' common scale over the present one."""
        return np.append(np.zeros(count), self.weights / gains)


def _improved(
    solved: SolvedProblem,
    columns: EffortColumns,
    raw: Sequence[Observations],
    unknowns: _Gains,
    gains: FloatArray,
    *,
    joints: tuple[str, ...],
) -> tuple[FloatArray, FloatArray]:
    """Return parameters (p,) and gains (r,) after linearised steps from a solution."""
    phi = solved.posterior.mean
    # With a prior that changes, steps go to and fro between wide links and unlike gains.
    problem = replace(solved.problem, prior=solved.posterior.prior, is_empirical=False)
    problem = _with_free_terms(problem, phi, joints)
    columns = columns.restricted(problem.parameters.names)
    rows = _rows_of(solved, raw).restricted(columns.layout.parameters)
    before, share = np.zeros(len(gains)), 1.0
    for _ in range(STEPS):
        linear = columns.linearised(rows, phi, gains)
        start = np.append(phi, gains)
        found = SolvedProblem.approximate(
            unknowns.added(problem, gains), linear, start, is_coupled=solved.chosen.is_coupled
        ).consistent_unknowns()
        phi, new = found[: len(phi)], found[len(phi) :]
        step = np.clip(new / gains - 1, -LARGEST_STEP, LARGEST_STEP)
        if step @ before < 0:  # it would oscillate
            share /= 2
        gains, before = gains * np.exp(share * step), step
        if np.abs(step).max() < CONVERGED:
            break
    return phi, gains


def _with_free_terms(problem: Problem, phi: FloatArray, joints: tuple[str, ...]) -> Problem:
    """Return a problem in which the prior of joints' terms, about φ (p,), is wide."""
    scale = np.ones(len(problem.prior.mean))
    names = problem.parameters.names
    for index in range(problem.parameters.inertial, len(names)):
        if names[index].rpartition("/")[0] in joints:
            scale[index] = max(1.0, FREE * abs(phi[index]) / problem.prior.std[index])
    return replace(problem, prior=problem.prior.widened(scale))


def _rows_of(solved: SolvedProblem, raw: Sequence[Observations]) -> Observations:
    """Return the rows that a solution used, with efforts and all candidate terms as columns."""
    choice = solved.problem.choice
    used = raw if choice is None else choice.rows(raw)
    (rows,) = (one for one in used if one.window == solved.chosen.window)
    return rows


def _whole(problem: Problem, solved: SolvedProblem, phi: FloatArray) -> FloatArray:
    """Return the parameters (p,) of all candidate terms, with those of a solution (p',)."""
    whole = problem.prior.mean.copy()
    whole[[problem.prior.names.index(name) for name in solved.problem.parameters.names]] = phi
    return whole
