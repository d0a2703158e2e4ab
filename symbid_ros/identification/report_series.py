"""Computes what a report shows of a log: predicted forces, spectra, coverage, motion."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.log_checks import LogChecks
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation import validate_segments
from symbid_ros.identification.predictions.validation_result import PredictedEfforts
from symbid_ros.identification.report_data import (
    QUANTILES,
    Coverage,
    ForceSeries,
    ParameterSpread,
    PredictedLog,
    ReportData,
)
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import PROBE_PERIOD

MOST_ROWS = 1500  # shown over time: a minute of rows at 25 Hz
MOST_SPEEDS = 1000  # rows shown against the speed
SPECTRUM_ROWS = 64  # rows of one spectrum, which are averaged
TRACE_PERIOD = 0.01  # s between positions from which speeds are computed
LEAST_SPAN = 0.04  # s over which a speed is averaged at least
# Times without data that are shorter, s, are those between two filters.
LEAST_GAP = 0.3


@dataclass
class PositionTrace:
    """Joint positions of segments that pass through it.

    Attributes
    ----------
    stamps : list of (N,) int64
        Nanoseconds.
    positions : list of (N, J) float64
        rad or m.
    """

    stamps: list[IntArray] = field(default_factory=list)
    positions: list[FloatArray] = field(default_factory=list)

    def of(self, segments: Iterable[Segment]) -> Iterator[Segment]:
        """Yield the segments and keep their positions at few instants."""
        for segment in segments:
            # Indices copy; a slice would be a view and keep the whole segment in memory.
            kept = np.arange(0, len(segment), max(1, round(TRACE_PERIOD * segment.rate)))
            self.stamps.append(segment.stamp[kept])
            self.positions.append(segment.position[kept])
            yield segment

    def speeds(self, stamp: IntArray, span: float) -> FloatArray:
        """Return mean speeds (N, J) over ``span``, s, around stamps (N,), ns."""
        known, position = np.concatenate(self.stamps), np.concatenate(self.positions)
        origin, half = int(known[0]), max(span, LEAST_SPAN) / 2
        time, at = (known - origin) * 1e-9, (stamp - origin) * 1e-9
        speed = np.empty((len(stamp), position.shape[1]))  # also of a body without joints
        for joint, column in enumerate(position.T):
            moved = np.interp(at + half, time, column) - np.interp(at - half, time, column)
            speed[:, joint] = moved / (2 * half)
        return speed


def force_series(
    efforts: PredictedEfforts,
    model: RobotModel,
    trace: PositionTrace,
    *,
    begin: int,
    window: float,
    is_held_out: bool,
) -> ForceSeries:
    """Return measured and predicted forces of a part of a log.

    Parameters
    ----------
    efforts : PredictedEfforts
        The rows of this part.
    model : RobotModel
    trace : PositionTrace
        Its positions.
    begin : int
        Stamp of the start of the log, ns.
    window : float
        Length of the rows' windows, s; 0 for filtered rows.
    is_held_out : bool
        See :class:`ForceSeries`.
    """
    first = 6 * model.floating
    measured, before, after = (
        np.concatenate(pair, axis=1)
        for pair in (
            (efforts.wrench_measured, efforts.measured),
            (efforts.wrench_before, efforts.before),
            (efforts.wrench_after, efforts.after),
        )
    )
    time = np.asarray((efforts.stamp - begin) * 1e-9, dtype=np.float64)
    rest_before, rest_after = measured - before, measured - after
    shown = _eventful_stretch(time, measured)
    places = np.unique(np.linspace(0, len(time) - 1, min(len(time), MOST_SPEEDS)).round())
    some = places.astype(np.int64)
    speed = np.full((len(some), measured.shape[1]), np.nan)
    moving = list(model.moving_joints)  # a component of a wrist sensor has no speed
    speed[:, first + np.array(moving, dtype=int)] = trace.speeds(efforts.stamp[some], window)[
        :, moving
    ]
    frequency, powers = _spectra(time, (measured, rest_before, rest_after))
    return ForceSeries(
        coordinates=model.coordinates,
        units=model.coordinate_units,
        time=time[shown],
        measured=measured[shown],
        before=before[shown],
        after=after[shown],
        frequency=frequency,
        power_measured=powers[0],
        power_before=powers[1],
        power_after=powers[2],
        speed=speed,
        speed_before=rest_before[some],
        speed_after=rest_after[some],
        rms_measured=_rms(measured),
        rmse_before=_rms(rest_before),
        rmse_after=_rms(rest_after),
        start=float(time[0]),
        stop=float(time[-1]),
        is_held_out=is_held_out,
    )


def _rms(values: FloatArray) -> FloatArray:
    """Return the RMS (n,) of the rows that are used; NaN without any."""
    used = np.isfinite(values)
    count = used.sum(axis=0)
    squares = np.where(used, values, 0.0) ** 2
    mean = squares.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.sqrt(mean), np.nan)


def _eventful_stretch(time: FloatArray, measured: FloatArray) -> IntArray:
    """Return consecutive rows, at most ``MOST_ROWS``, in which the forces vary most.

    Rows at more than 25 Hz are thinned out first.
    """
    rate = 1 / max(float(np.median(np.diff(time))), 1e-9) if len(time) > 1 else 1.0
    rows = np.arange(0, len(time), max(1, round(rate / 25)))
    if len(rows) <= MOST_ROWS:
        return rows
    values = measured[rows]
    scale = np.nanstd(values, axis=0, where=np.isfinite(values))
    steps = np.abs(np.diff(values, axis=0, prepend=values[:1])) / np.where(scale > 0, scale, 1.0)
    events = np.cumsum(np.nan_to_num(steps).sum(axis=1))
    best = int(np.argmax(events[MOST_ROWS:] - events[:-MOST_ROWS]))
    return rows[best : best + MOST_ROWS]


def _spectra(
    time: FloatArray, signals: tuple[FloatArray, ...]
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return frequencies (F,) and power spectral densities (F, n) of signals (N, n).

    Rows have gaps between blocks, so spectra of stretches without gap are averaged.
    """
    empty = tuple(np.zeros((0, one.shape[1])) for one in signals)
    if len(time) < 8:
        return np.zeros(0), empty
    step = float(np.median(np.diff(time)))
    runs = np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > 1.5 * step) + 1)
    length = min(SPECTRUM_ROWS, int(np.median([len(run) for run in runs])))
    runs = [run for run in runs if len(run) >= length]
    if length < 8 or not runs:
        return np.zeros(0), empty
    powers = []
    for signal in signals:
        used = np.isfinite(signal)
        share = np.maximum(used.mean(axis=0), 1e-12)
        filled = np.where(used, signal, 0.0)
        powers.append(np.mean([_welch(filled[run], length, step) for run in runs], axis=0) / share)
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(length, step), dtype=np.float64)
    # The mean is removed, so the first bin is empty.
    return frequency[1:], tuple(power[1:] for power in powers)


def _welch(signal: FloatArray, length: int, step: float) -> FloatArray:
    """Return the power spectral density (F, n) of a signal (N, n) by Welch's method (1967).

    SciPy's function gives the same; importing it takes longer than all spectra.
    """
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    starts = range(0, len(signal) - length + 1, length - length // 2)
    parts = np.stack([signal[start : start + length] for start in starts])
    parts = (parts - parts.mean(axis=1, keepdims=True)) * window[:, None]
    power: FloatArray = np.mean(np.abs(np.fft.rfft(parts, axis=1)) ** 2, axis=0)
    power *= step / np.sum(window**2)
    # Negative frequencies count as well; zero and half the rate have none.
    power[1 : (length + 1) // 2] *= 2
    return power


def coverage(problem: LoadedProblem) -> Coverage:
    """Return the used parts of a problem's log, its faults, and the motion it contains."""
    dataset, checks = problem.dataset, problem.checks
    samples = dataset.samples
    stamp, position = samples.stamp, samples.position
    if len(stamp) > 1:
        period = float(np.median(np.diff(stamp))) * 1e-9
        stride = max(1, round(PROBE_PERIOD / max(period, 1e-9)))
        stamp, position = stamp[::stride], position[::stride]
    return _coverage(
        dataset.source,
        stamp,
        position,
        problem.parameters.model.joint_names,
        spans=dataset.spans,
        checks=checks,
        is_checked=not problem.options.unchecked,
    )


def _coverage(
    source: str,
    stamp: IntArray,
    position: FloatArray,
    joints: tuple[str, ...],
    *,
    spans: Sequence[tuple[int, int]] = (),
    checks: LogChecks,
    is_checked: bool,
) -> Coverage:
    """Return what a log consists of, from joint positions (N, J) at stamps (N,), ns.

    Without ``spans`` of the parts between gaps, gaps shorter than the stamps' distance do not show.
    """
    begin = min([int(stamp[0]), *(one.start for one in checks.spans)])
    time = np.asarray((stamp - begin) * 1e-9, dtype=np.float64)
    step = np.diff(time)
    breaks = np.flatnonzero(step > LEAST_GAP)
    starts, stops = np.r_[0, breaks + 1], np.r_[breaks, len(time) - 1]
    used = np.stack([time[starts], time[stops]], axis=1)
    if spans:
        used = np.asarray((np.array(spans, dtype=np.int64) - begin) * 1e-9, dtype=np.float64)
    speed = np.abs(np.diff(position, axis=0)) / step[:, None]
    speed = speed[step <= LEAST_GAP]
    if not len(speed):
        speed = np.zeros((1, position.shape[1]))
    return Coverage(
        log=source,
        begin=begin,
        used=used,
        faults=_faults(checks, begin),
        findings=tuple(one.as_dict() for one in checks.findings),
        is_checked=is_checked,
        joints=joints,
        position=np.quantile(position, QUANTILES, axis=0).T,
        speed=np.quantile(speed, QUANTILES, axis=0).T,
        mean_posture=position.mean(axis=0),
    )


def _faults(checks: LogChecks, begin: int) -> tuple[dict[str, object], ...]:
    return tuple(
        {
            "kind": one.kind.value,
            "stream": one.stream,
            "start": (one.start - begin) * 1e-9,
            "stop": (one.stop - begin) * 1e-9,
        }
        for one in checks.spans
    )


def report_data(
    problem: LoadedProblem, found: Identification, forces: ForceSeries | None, log: Coverage
) -> ReportData:
    """Return what a report shows of an identification."""
    names = found.estimate.names
    prior_std = np.linalg.norm(problem.solved.posterior.prior_factor[: len(names)], axis=1)
    change = found.scale_change
    return ReportData(
        forces,
        log,
        ParameterSpread(
            names,
            prior_std if found.factor is not None else np.zeros(0),
            np.zeros(len(names)) if change is None else change,
        ),
    )


def predicted_log(predictor: ForcePredictor, log: Log) -> PredictedLog:
    """Return what a report shows of any log of an identified robot.

    Raises
    ------
    SymbidError
        When the log is invalid, too short, or of another robot.
    """
    model, trace = predictor.parameters.model, PositionTrace()
    streams = StreamChecks(model)
    segments = AlignedLog(log, model, checks=streams)
    validation = validate_segments(predictor, trace.of(segments), log.source)
    checks = LogChecks(tuple(streams.findings(log.source)), spans=streams.spans)
    stamp, position = np.concatenate(trace.stamps), np.concatenate(trace.positions)
    stride = round(PROBE_PERIOD / TRACE_PERIOD)
    found = _coverage(
        log.source,
        stamp[::stride],
        position[::stride],
        model.joint_names,
        checks=checks,
        is_checked=True,
    )
    window = predictor.settings.window or 0.0
    forces = force_series(
        validation.efforts, model, trace, begin=found.begin, window=window, is_held_out=False
    )
    names = predictor.parameters.names
    data = ReportData(forces, found, ParameterSpread(names, np.zeros(0), np.zeros(len(names))))
    return PredictedLog(data, validation.seconds, validation.seconds_used)
