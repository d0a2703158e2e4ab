"""Finds torques that repeat in a turn of a joint, when the joints' terms leave residuals.

For each revolute joint and each number of periods, a score test gives by how much the squared
residuals would fall with the two columns of such a torque, all other parameters adjusted. The best
number of each joint is a candidate, and those that improve the prediction of rows that are left out
are added. A joint that passes over its angles only once or twice is skipped, because any slow
change then resembles a function of the angle.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.estimation.term_evidence import predictive_effects, ripple_torques
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.trial import leaves_residuals, training_part, try_columns
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.ripple import Ripple
from symbid_ros.signals.sampled_rows import RowBuilder, SampledRows
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.signals.weak_form import windowed_rows

logger = logging.getLogger(__name__)

# Numbers of periods in a turn that are tried.
PERIODS = range(2, 41)
# Share of a joint's square residuals that a candidate must explain.
LEAST_SHARE = 0.2
# How often a joint passes over the range of its angles, at least.
LEAST_PASSES = 2.5
# Share of a column's square that the known columns leave, below which they replace it.
REPLACED = 1e-6


def find_ripples(solved: SolvedProblem, dataset: Dataset) -> tuple[Ripple, ...]:
    """Return the ripples that a log shows, at most one for each joint; none in white residuals.

    ``solved`` has chosen joint terms and no ripples.
    """
    choice = solved.problem.choice
    if choice is None or choice.parameters.ripples or not leaves_residuals(solved):
        return ()
    training = training_part(solved, dataset)
    likely = _likely_ripples(solved, training, _passes(dataset.segments, solved.chosen.window))
    if not likely:
        return ()
    parameters = replace(choice.parameters, ripples=likely)
    trial = try_columns(solved, training, dataset.source, parameters, slips=choice.slips)
    if trial is None:
        return ()
    effects = ripple_torques(parameters)
    ripples = predictive_effects(trial.found, trial.chosen, effects, trial.free)
    model = parameters.model
    for one in ripples:
        logger.warning(
            "%s: a torque repeats %d times in a turn of %s, and is identified as well; a live run "
            "needs `ripple` %s",
            dataset.source,
            one.periods,
            model.joint_names[one.joint],
            one.label(model),
        )
    return tuple(sorted(ripples, key=lambda one: one.joint))


def _likely_ripples(
    solved: SolvedProblem, training: Iterable[Segment], passes: FloatArray
) -> tuple[Ripple, ...]:
    """Return the best ripple of each joint (J,) that explains enough of its residuals."""
    problem, posterior = solved.problem, solved.posterior
    prior = posterior.prior
    parameters = problem.parameters
    model = parameters.model
    first, known = 6 * model.floating, len(prior.mean)
    forces = solved.chosen.rows.target_squares[first:]
    joints = [
        joint
        for joint in parameters.joints.tolist()
        if model.joints[joint].kind == "revolute"
        and joint not in model.followers
        and forces[joint] > 0
        and passes[joint] >= LEAST_PASSES
    ]
    if not joints:
        return ()
    choice = problem.choice
    assert choice is not None
    build = _RippleRows(problem.row_builder, parameters)
    # Of each coordinate's rows: known columns, sines and cosines, residuals at the prior's mean.
    moments = np.zeros((model.dof, known + 2 * len(PERIODS) + 1, known + 2 * len(PERIODS) + 1))
    weight = 1 / np.sqrt(posterior.covariance.diagonal())
    for segment in training:
        for (block,) in windowed_rows(segment, build, (solved.chosen.window,), ()):
            used = block.slipping() if choice.slips else block
            error = used.mean.y - used.mean.K[:, :, :known] @ prior.mean
            rows = np.concatenate([used.mean.K, error[:, :, None]], axis=2) * weight[:, None]
            moments += rows.transpose(1, 2, 0) @ rows.transpose(1, 0, 2)
    # The known unknowns from these rows alone: their deviations and shift from the prior's mean.
    L, total = prior.covariance_factor(), moments.sum(axis=0)
    precision = np.eye(known) + L.T @ total[:known, :known] @ L
    deviations = np.asarray(np.linalg.solve(np.linalg.cholesky(precision), L.T).T, np.float64)
    shift = deviations @ (deviations.T @ total[:known, -1])
    at_estimate = np.eye(len(total))
    at_estimate[:known, -1] = -shift
    found = []
    for joint in joints:
        moment = at_estimate.T @ moments[first + joint] @ at_estimate
        shares = _explained_shares(moment, deviations)
        best = int(np.argmax(shares))
        if shares[best] > LEAST_SHARE:
            found.append(Ripple(joint, PERIODS[best]))
    return tuple(found)


def _passes(segments: Iterable[Segment], window: float) -> FloatArray:
    """Return how often each joint (J,) passes over the range of its angles, at most a turn.

    Noise moves no joint, so angles are compared at intervals of a window's length, s.
    """
    angles = [part.position[:: max(1, round(window * part.rate))] for part in segments]
    way = np.sum([np.abs(np.diff(part, axis=0)).sum(axis=0) for part in angles], axis=0)
    reach = np.minimum(np.ptp(np.concatenate(angles), axis=0), 2 * np.pi)
    passes: FloatArray = np.divide(way, reach, out=np.zeros_like(reach), where=reach > 0)
    return passes


def _explained_shares(moment: FloatArray, deviations: FloatArray) -> FloatArray:
    """Return the share of the square residuals that each number of periods explains.

    The moment (k + m + 1, k + m + 1) is that of the k known columns, sines and cosines of all
    numbers of periods, and the residuals. ``deviations`` (k, k) is a factor of the covariance of
    the k unknowns.
    """
    known = len(deviations)
    total = float(moment[-1, -1])
    if total == 0:
        return np.zeros(len(PERIODS))
    # What is left of the columns when the known ones are adjusted.
    shared = deviations.T @ moment[:known, known:-1]
    left = moment[known:-1, known:-1] - shared.T @ shared
    pull = moment[known:-1, -1]
    shares = []
    for place in range(len(PERIODS)):
        some = slice(2 * place, 2 * place + 2)
        square = left[some, some]
        floor = REPLACED * np.trace(moment[known:-1, known:-1][some, some])
        values, axes = np.linalg.eigh(square)
        usable = values > floor
        shares.append(np.sum((axes.T @ pull[some])[usable] ** 2 / values[usable]) / total)
    return np.array(shares)


@dataclass(frozen=True)
class _RippleRows:
    """Builds rows with sines and cosines of the angle of each row's joint, a ``RowBuilder``.

    ``build`` builds the rows of the identified unknowns.
    """

    build: RowBuilder
    parameters: ParameterSet

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        first, start = 6 * self.parameters.model.floating, 0
        for part in self.build(readings):
            count, n, _ = part.rows.K.shape
            angle = readings.position[start : start + count, :, None] * np.array(PERIODS)
            own = np.zeros((count, n, len(PERIODS), 2))
            own[:, first:, :, 0], own[:, first:, :, 1] = np.sin(angle), np.cos(angle)
            K = np.concatenate([part.rows.K, own.reshape(count, n, -1)], axis=2)
            yield replace(part, rows=Rows(K, part.rows.y))
            start += count
