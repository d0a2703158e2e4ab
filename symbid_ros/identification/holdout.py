"""Check of an identification on the end of its own log, which a trial identification leaves out."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.dataset import Processing, fold_dataset
from symbid_ros.identification.force_errors import RELEVANT
from symbid_ros.identification.gain_check import Trial, wrist_sensor_alarms, wrong_factors
from symbid_ros.identification.joint_alarms import with_joint_alarms
from symbid_ros.identification.likely_cause import explained
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.prediction import ForcePredictor
from symbid_ros.identification.report_data import ForceSeries
from symbid_ros.identification.report_series import (
    PositionTrace,
    coverage,
    force_series,
    report_data,
)
from symbid_ros.identification.solver import Identification
from symbid_ros.identification.validation import validate_segments
from symbid_ros.identification.warming import during
from symbid_ros.progress import report
from symbid_ros.signals.segments import RemoteSegments, Segment, split
from symbid_ros.signals.weak_form import WINDOWS

# Instants between which postures are compared, s, and over which speeds are measured.
PERIOD, STEP = 0.05, 0.1
# Distance, in standard deviations of posture and speed, below which a state occurred before.
NEAR = 0.1
# Motion of a joint below which it is at rest, rad or m.
REST = 0.01
# Share of states that occurred before, from which a motion repeats.
REPEATED = 0.9
MOST_STATES, MOST_QUERIES = 20_000, 1_000
# Verdicts with which the stated prior is tried.
NOT_BETTER = "worse", "mixed", "unfit"
PRIOR_KEPT = (
    "the prior is kept at ±25 % (keep_prior): with the one that the data ask for, the trial erred "
    "more, {}"
)
AT_REST = (
    "no joint moves: the log shows the forces in one posture, from which those in other postures "
    "do not follow, and its end is the same posture again; record motion of all joints"
)
UNPREDICTED = (
    "the log does not predict its own end: {}; record longer and more varied motion, or correct "
    "what differs there, such as a load or a contact"
)


def identify_with_holdout(problem: LoadedProblem) -> tuple[LoadedProblem, Identification]:
    """Identify a log; a trial without its last quarter shows how well that is predicted.

    The trial chooses joint terms, prior scale and sensor errors from the earlier part alone. It
    uses the window length of the whole log. If the identified robot predicts the last quarter worse
    than the model file, and better with the stated prior, that prior is kept: where the equation of
    motion is wrong, the data would widen it without bound. If factors on some joints' efforts
    predict it much better, these are identified, and an alarm says so.

    Returns
    -------
    LoadedProblem
        The problem that was solved: the given one, or the same with the stated prior or with
        factors of efforts.
    Identification

    Raises
    ------
    SymbidError
        When the log cannot be identified.
    """
    report("solving")
    found = problem.solve()
    log = coverage(problem)
    checked, forces = None, None
    if not problem.options.no_holdout:
        report("holding out the end of the log")
        try:
            checked, forces = _hold_out(problem, found.window, log.begin)
        except SymbidError as error:
            checked = HoldOut(0.0, None, None, "none", 0.0, {}, f"no part of the log: {error}")
        if checked.advice in NOT_BETTER and problem.options.is_empirical:
            better = _with_kept_prior(problem, checked, log.begin)
            if better is not None:
                problem, found, checked, forces = better
    alarm = None
    if checked is not None and checked.advice == "unfit":
        alarm = UNPREDICTED.format(checked.summary)
    elif checked is not None:
        wrong = wrong_factors(problem, checked, lambda one: _tried(one, log.begin))
        if wrong is not None:
            alarm = wrong.alarm
            problem, found, checked, forces = wrong.trial or (problem, found, checked, forces)
    found = problem.with_provenance(with_joint_alarms(problem, explained(problem, found)))
    for one in wrist_sensor_alarms(problem):
        found = _with_alarm(found, one)
    if alarm is not None:
        found = _with_alarm(found, alarm)
    if not problem.columns.model.floating and not _moving(problem.dataset.segments).any():
        found = _with_alarm(found, AT_REST)
    if forces is None:
        forces = _predict_end(problem, found, log.begin)
    found = replace(
        found,
        estimate=replace(found.estimate, holdout=checked),
        report=report_data(problem, found, forces, log),
    )
    return problem, found


def _with_alarm(found: Identification, alarm: str) -> Identification:
    verdict = found.estimate.verdict
    if verdict is None:
        return found
    verdict = replace(verdict, alarms=(*verdict.alarms, alarm))
    return replace(found, estimate=replace(found.estimate, verdict=verdict))


def _tried(problem: LoadedProblem, begin: int) -> Trial:
    found = problem.solve()
    return Trial(problem, found, *_hold_out(problem, found.window, begin))


def _with_kept_prior(problem: LoadedProblem, before: HoldOut, begin: int) -> Trial | None:
    """Identify with the stated prior; None unless that predicts the end of the log better."""
    kept = problem.with_prior(problem.prior, replace(problem.options, keep_prior=True))
    try:
        trial = _tried(kept, begin)
    except SymbidError:
        return None
    found, checked = trial.found, trial.checked
    errors = checked.percent_after, before.percent_after
    if errors[0] is None or errors[1] is None or RELEVANT * errors[0] >= errors[1]:
        return None
    remarks = (*found.estimate.remarks, PRIOR_KEPT.format(before.summary))
    return trial._replace(found=replace(found, estimate=replace(found.estimate, remarks=remarks)))


def check_holdout(problem: LoadedProblem, window: float) -> HoldOut:
    """Identify a log without its end and predict the latter.

    Parameters
    ----------
    problem : LoadedProblem
    window : float
        Length of the windows, s; 0 for filtered rows.

    Raises
    ------
    SymbidError
        When one of both parts is too short.
    """
    return _hold_out(problem, window, 0)[0]


def _predict_end(problem: LoadedProblem, found: Identification, begin: int) -> ForceSeries | None:
    """Predict the last quarter of the log, or all of a short one, with the final estimate."""
    dataset, trace = problem.dataset, PositionTrace()
    predictor = ForcePredictor.of(found, problem.parameters)
    part = dataset.segments
    with suppress(SymbidError):
        _, part = split(dataset.segments, max(found.window, *WINDOWS), dataset.source)
    try:
        efforts = validate_segments(predictor, trace.of(part), dataset.source).efforts
    except SymbidError:  # too short for a prediction
        return None
    model = predictor.parameters.model
    return force_series(efforts, model, trace, begin=begin, window=found.window, is_held_out=False)


def _hold_out(problem: LoadedProblem, window: float, begin: int) -> tuple[HoldOut, ForceSeries]:
    """Return the check on the end of the log and the forces predicted there."""
    dataset, trace = problem.dataset, PositionTrace()
    training, held_out = split(dataset.segments, max(window, *WINDOWS), dataset.source)
    processing = Processing.of(problem.options)
    if processing.smoothing is None:
        processing = replace(processing, windows=(window,))
    else:
        training, held_out = tuple(training), tuple(held_out)
    columns = during(problem.columns, training)
    trial = problem.trial_on(
        fold_dataset(training, f"{dataset.source}, without its end", columns, processing), columns
    )
    predictor = ForcePredictor.of(trial.solve(), trial.parameters)
    found = validate_segments(predictor, trace.of(held_out), f"{dataset.source}, its end")
    repeats = repeated_share(training, held_out)
    summary = f"{found.change} on the last {found.seconds:.0f} s"
    if found.advice == "worse":
        summary += ", worse than the original model"
    elif found.advice == "mixed":
        summary += f"; {' and '.join(found.worse)} got worse"
    elif found.advice == "unfit":
        summary += ", more than was measured"
    if repeats >= REPEATED:
        summary += "; the motion repeats itself there, so other motions may be predicted worse"
    model = predictor.parameters.model
    forces = force_series(found.efforts, model, trace, begin=begin, window=window, is_held_out=True)
    checked = HoldOut(
        seconds=found.seconds,
        percent_before=found.percent_before,
        percent_after=found.percent_after,
        advice=found.advice,
        repeats=repeats,
        coordinates={one.name: (one.rmse_before, one.rmse_after) for one in found.coordinates},
        summary=summary,
        file_percents=found.file_percents,
    )
    return checked, forces


def repeated_share(training: Iterable[Segment], held_out: Iterable[Segment]) -> float:
    """Return the share of held-out instants whose postures and speeds occurred in the training.

    States are compared with the whole path through the earlier ones, not with its samples alone.
    Joints at rest do not count, nor does the motion of a floating base.
    """
    before, after = _states(training), _states(held_out)
    if not before or not after:
        return 0.0
    every = np.concatenate(before)
    std = every.std(axis=0)
    moves = np.tile(_is_moving(every), 2) & (std > 0)
    if not moves.any():
        return 1.0
    queries = np.concatenate(after)[:, moves] / std[moves]
    queries = queries[:: 1 + len(queries) // MOST_QUERIES]
    paths = [one[:, moves] / std[moves] for one in before]
    stride = 1 + len(every) // MOST_STATES
    paths = [one[::stride] for one in paths]
    ends = np.concatenate([np.r_[np.ones(len(one) - 1, bool), False] for one in paths])
    points = np.concatenate(paths)
    nearest = np.asarray(cKDTree(points).query(queries)[1])
    distance = np.minimum(
        _distance(queries, points, nearest, ends), _distance(queries, points, nearest - 1, ends)
    )
    return float(np.mean(distance <= NEAR * np.sqrt(np.count_nonzero(moves))))


def _moving(segments: Iterable[Segment]) -> BoolArray:
    """Return which joints (J,) of a log move; all if it is too short to tell."""
    states = _states(segments)
    return _is_moving(np.concatenate(states)) if states else np.ones(1, dtype=bool)


def _is_moving(states: FloatArray) -> BoolArray:
    """Return which joints move in states (N, 2 J)."""
    joints = states.shape[1] // 2
    moves: BoolArray = states[:, :joints].std(axis=0) > REST
    return moves


def _states(segments: Iterable[Segment]) -> list[FloatArray]:
    """Return joint positions and speeds (N, 2 J) of each segment at few of its instants."""
    if isinstance(segments, RemoteSegments):
        return segments.apply(_states)
    states = []
    for segment in segments:
        stride = max(1, round(PERIOD * segment.rate))
        step = max(1, round(STEP * segment.rate))
        # Indices copy; a slice would keep the states at all instants in memory.
        places = np.arange(0, len(segment) - step, stride)
        position = segment.position[places]
        speed = (segment.position[places + step] - position) * segment.rate / step
        if len(places):
            states.append(np.concatenate([position, speed], axis=1))
    return states


def _distance(
    queries: FloatArray, points: FloatArray, index: IntArray, continues: BoolArray
) -> FloatArray:
    """Return the distances of queries (N, d) from the lines that start at points ``index`` (N,)."""
    index = np.maximum(index, 0)
    start = points[index]
    stop = points[np.minimum(index + 1, len(points) - 1)]
    along = np.where(continues[index, None], stop - start, 0.0)
    length = np.sum(along**2, axis=1)
    share = np.sum((queries - start) * along, axis=1) / np.where(length > 0, length, 1.0)
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * along
    distance: FloatArray = np.linalg.norm(queries - foot, axis=1)
    return distance
