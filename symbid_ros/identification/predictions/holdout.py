"""Check of an identification on the end of its own log, which a trial identification leaves out."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.end_check import EndCheck
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation import validate_segments
from symbid_ros.identification.report_series import PositionTrace, force_series
from symbid_ros.identification.rows.dataset import Processing, fold_dataset
from symbid_ros.identification.terms.further_terms import during
from symbid_ros.signals.segments import HELD_OUT, RemoteSegments, Segment, split
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


def hold_out(problem: LoadedProblem, window: float, begin: int) -> EndCheck:
    """Identify a log without its last quarter and predict the latter.

    ``window`` is the length of the windows, s, 0 for filtered rows. The log begins at ``begin``,
    ns.

    Raises
    ------
    SymbidError
        When one of both parts is too short.
    """
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
        summary += f"; {enumerate_words(found.worse)} got worse"
    elif found.advice == "unfit":
        summary += ", an error larger than the measured forces"
    if repeats >= REPEATED:
        summary += "; the motion repeats itself there, so other motions may be predicted worse"
    model = predictor.parameters.model
    forces = force_series(found.efforts, model, trace, begin=begin, window=window, is_held_out=True)
    holdout = HoldOut(
        seconds=found.seconds,
        percent_before=found.percent_before,
        percent_after=found.percent_after,
        advice=found.advice,
        repeats=repeats,
        coordinates={one.name: (one.rmse_before, one.rmse_after) for one in found.coordinates},
        summary=summary,
        file_percents=found.file_percents,
    )
    return EndCheck(holdout, forces, window, predictor, held_out)


def rest_at_end(problem: LoadedProblem) -> str:
    """Say that no joint of a fixed base moves in the end of the log; empty if one does."""
    segments = problem.dataset.segments
    if problem.parameters.model.floating or isinstance(segments, RemoteSegments):
        return ""
    trace = PositionTrace()
    for _ in trace.of(segments):
        pass
    stamp, position = np.concatenate(trace.stamps), np.concatenate(trace.positions)
    is_away = np.any(np.abs(position - position[-1]) > REST, axis=1)
    ended = stamp[is_away][-1] if is_away.any() else stamp[0]
    rest = 1e-9 * float(stamp[-1] - ended)
    if rest < HELD_OUT * 1e-9 * float(stamp[-1] - stamp[0]):
        return ""
    return f"the joints rest in its last {rest:.0f} s; leave these out with `stop`"


def repeated_share(training: Iterable[Segment], held_out: Iterable[Segment]) -> float:
    """Return the share of held-out instants whose postures and speeds occurred in the training.

    States are compared with the whole path through the earlier ones, not with its samples alone.
    Joints at rest do not count, nor does the motion of a floating base.
    """
    before, after = _states(training), _states(held_out)
    if not before or not after:
        return 0.0
    every = np.concatenate(before)
    joints, std = every.shape[1] // 2, every.std(axis=0)
    moves = np.tile(std[:joints] > REST, 2) & (std > 0)
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
