"""From a log to information: everything that happens before a method is chosen."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.diagnosis.findings import Finding
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import moving_segments, warned_once
from symbid_ros.signals.filters import LowPass, SavitzkyGolay, Smoothing, row_inflation
from symbid_ros.signals.log import Log
from symbid_ros.signals.noise_floor import MOTION, Channel
from symbid_ros.signals.segments import Segment, cut_to, fingerprint
from symbid_ros.signals.sensor_samples import at_base, build_samples, joined, smoothed
from symbid_ros.signals.weak_form import (
    ALL_WINDOWS,
    BLOCK,
    RowBuilder,
    check_windows,
    equation_rows,
    sampled_rows,
    suited_windows,
    windowed_rows,
)

# Slices are of whole blocks, over which no window reaches: where they are cut makes no difference.
SPAN = 15 * BLOCK
# Bytes of aligned channels that are kept rather than read again: five minutes of Symbitron.
MOST_KEPT = 128 << 20

logger = logging.getLogger(__name__)


class AlignedLog:
    """The stretches of a recording at which every sensor spoke; iterate as often as needed.

    Parameters
    ----------
    log : Log
        Read piece by piece.
    model : RobotModel
        Kinematics and frames.
    span : int
        Length of the slices that are in memory at a time, ns.
    most_kept : int
        Bytes of stretches that are kept rather than read again.
    checks : StreamChecks, optional
        Takes every slice as it is read for the first time. It says what is wrong with the streams,
        so that reading warns of nothing but what is left out.

    Raises
    ------
    BagError, DataError, ModelError
        While iterating, when a bag, its data or the model does not serve.
    """

    def __init__(
        self,
        log: Log,
        model: RobotModel,
        *,
        span: int = SPAN,
        most_kept: int = MOST_KEPT,
        checks: StreamChecks | None = None,
    ) -> None:
        self._log, self._model = log, model
        self._span, self._most_kept = span, most_kept
        self._checks = checks
        self._kept: tuple[Segment, ...] | None = None
        self._has_been_read = False

    def __iter__(self) -> Iterator[Segment]:
        if self._kept is not None:
            yield from self._kept
            return
        kept: list[Segment] | None = []
        for segment in self._read(warn=not self._has_been_read):
            if kept is not None:
                kept.append(segment)
                if sum(one.nbytes for one in kept) > self._most_kept:
                    kept = None
            yield segment
        self._has_been_read = True
        self._kept = None if kept is None else tuple(kept)

    def whole_stretches(self) -> tuple[Segment, ...]:
        """Return the stretches as long as they are, all at once."""
        whole: list[Segment] = []
        for segment in self:
            if whole and whole[-1].is_continued_by(segment):
                whole[-1] = whole[-1].joined(segment)
            else:
                whole.append(segment)
        return tuple(whole)

    def _read(self, *, warn: bool) -> Iterator[Segment]:
        checks = self._checks if warn else None
        tell = warn and checks is None
        coverage = _Coverage(self._log.source)
        told: set[tuple[str, str]] = set()
        with warned_once(muted=not tell):
            for piece in self._log.slices(self._span, warn=tell):
                if checks is not None:
                    checks.take(piece)
                if piece.streams is None:
                    coverage.lose(DataError(piece.fault))
                    continue
                streams, findings = mask_faulty_messages(piece.streams)
                if tell:
                    _warn_once(findings, told)
                try:
                    segments = moving_segments(streams, self._model)
                except DataError as error:
                    coverage.lose(error)
                    continue
                for segment in cut_to(segments, piece.start, piece.stop):
                    coverage.take(segment)
                    yield segment
        coverage.check(warn=warn)


@dataclass
class _Coverage:
    """How much of a recording is in its stretches."""

    source: str
    first: Segment | None = None
    until: int = 0
    instants: int = 0
    faults: list[DataError] = field(default_factory=list)

    def take(self, segment: Segment) -> None:
        if self.first is None:
            self.first = segment
        elif segment.frames != self.first.frames:
            raise DataError(
                f"{self.source}: header.frame_id of a sensor changes from "
                f"{', '.join(self.first.frames)} to {', '.join(segment.frames)}; give each run "
                "separately"
            )
        self.until = int(segment.stamp[-1])
        self.instants += len(segment)

    def lose(self, fault: DataError) -> None:
        self.faults.append(fault)

    def check(self, *, warn: bool) -> None:
        """Refuse a recording without any stretch, and tell what is left out of another."""
        if self.first is None:
            raise (
                self.faults[0]
                if self.faults
                else DataError(
                    f"{self.source}: holds nothing of the time asked for; give an earlier start"
                )
            )
        if not warn:
            return
        for fault in self.faults[:1]:
            logger.warning("%s; %d slices of the log are left out", fault, len(self.faults))
        length = (self.until - int(self.first.stamp[0])) * 1e-9
        expected = round(length * self.first.rate) + 1
        if self.instants < expected:
            logger.warning(
                "%s: %d of %d instants lie in gaps and are left out",
                self.source,
                expected - self.instants,
                expected,
            )


def _warn_once(findings: Iterable[Finding], told: set[tuple[str, str]]) -> None:
    """Say of each kind and topic once that its messages are left out."""
    for finding in findings:
        if (finding.kind.value, finding.stream) not in told:
            told.add((finding.kind.value, finding.stream))
            logger.warning("%s; those messages are left out", finding.message)


SAMPLES_AT_ONCE = 1024  # samples whose rows are built at once

# Seconds between instants at which sensor noise is carried over to the rows.
PROBE_PERIOD = 0.05


@dataclass(frozen=True)
class Processing:
    """How bags become rows.

    Attributes
    ----------
    smoothing : Smoothing or None
        Filter and differentiator for rows at single instants; None averages rows over
        windows instead.
    windows : tuple of float
        Lengths of those windows to try, s; a log uses the shortest that suit its rate.
    """

    smoothing: Smoothing | None = None
    windows: tuple[float, ...] = ALL_WINDOWS

    @classmethod
    def of(cls, options: IdentifyOptions) -> "Processing":
        """Return the processing that options ask for."""
        if options.row_filter == "weak":
            return cls(windows=ALL_WINDOWS if options.window is None else (options.window,))
        if options.row_filter == "savitzky_golay":
            return cls(SavitzkyGolay(options.window or SavitzkyGolay.window))
        low_pass = LowPass() if options.cutoff is None else LowPass(options.cutoff)
        return cls(replace(low_pass, channels=options.channels or low_pass.channels))

    def __str__(self) -> str:
        """Return what a report says of it."""
        if self.smoothing is not None:
            return str(self.smoothing)
        if self.windows == ALL_WINDOWS:
            return "rows averaged over Hann windows of the length that tells most"
        lengths = " or ".join(f"{1e3 * window:g}" for window in self.windows)
        return f"rows averaged over Hann windows of {lengths} ms"


@dataclass(frozen=True)
class Dataset:
    """One recording, read and folded.

    Attributes
    ----------
    source : str
        Name of the log, for messages.
    segments : iterable of Segment
        Aligned sensor channels, as they were recorded; a long log is read again for them.
    samples : Samples
        Motion and forces after filtering, at instants far enough apart to be few.
    observations : tuple of Observations
        The rows, folded, for each length of window.
    """

    source: str
    segments: Iterable[Segment]
    samples: Samples
    observations: tuple[Observations, ...]


def read_dataset(
    log: Log,
    parameters: ParameterSet,
    processing: Processing | None = None,
    checks: StreamChecks | None = None,
) -> Dataset:
    """Read a log piece by piece, build samples and fold their rows.

    ``checks`` takes the streams on the way.

    Raises
    ------
    BagError, DataError, ModelError
        When a bag, its data or the model does not serve; the message says which.
    """
    processing = processing or Processing()
    aligned = AlignedLog(log, parameters.model, checks=checks)
    segments = aligned if processing.smoothing is None else aligned.whole_stretches()
    return fold_dataset(segments, log.source, parameters, processing)


def fold_dataset(
    segments: Iterable[Segment],
    source: str,
    parameters: ParameterSet,
    processing: Processing,
) -> Dataset:
    """Do the same with stretches that have been read from a log of that name.

    Raises
    ------
    DataError, ModelError
        When the data or the model does not serve; the message says which.
    """
    model, smoothing = parameters.model, processing.smoothing
    if smoothing is None:
        layout = RowLayout.of(parameters)
        probes: list[Samples] = []
        windows = processing.windows
        used: set[float] = set()
        checked = _checked(segments, windows, source, used)
        observations = observe(
            _probed(checked, model, probes), equation_rows(parameters), layout, windows
        )
        samples = joined(probes)
        observations = tuple(one for one in observations if one.rows.samples > 0)
        if not observations:
            raise DataError(
                f"{source}: the log is too short, not even a window of {1e3 * min(used):g} ms and "
                "the edges of its filter fit between two gaps; record longer"
            )
    else:
        stretches = tuple(segments)
        samples = build_samples(stretches, model, smoothing, source)
        inflation = row_inflation(smoothing, stretches[0].rate)
        rows = (sampled_rows(parameters, block) for block in samples.blocks(SAMPLES_AT_ONCE))
        unwindowed = Observations.unwindowed(RowLayout.of(parameters), rows, inflation)
        observations = (unwindowed.covering(frozenset().union(*map(fingerprint, stretches))),)
        segments = stretches
    return Dataset(source, segments, samples, observations)


def observe(
    segments: Iterable[Segment],
    build: RowBuilder,
    layout: RowLayout,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
) -> tuple[Observations, ...]:
    """Fold the windowed rows of aligned segments, for each length of window.

    Each segment adds rows to the windows that suit its rate; the others may stay empty.
    """
    observations = {window: Observations.empty(layout, window) for window in windows}
    for segment in segments:
        used = suited_windows(windows, segment.rate)
        for blocks in windowed_rows(segment, build, used, noisy_channels):
            for window, block in zip(used, blocks, strict=True):
                observations[window] = observations[window].fold([block])
        covered = fingerprint(segment)
        for window in used:
            observations[window] = observations[window].covering(covered)
    return tuple(observations.values())


def _checked(
    segments: Iterable[Segment], windows: Sequence[float], source: str, used: set[float]
) -> Iterator[Segment]:
    """Pass stretches on and collect the windows that suit their rates; refuse rates too low."""
    for segment in segments:
        check_windows(windows, segment.rate, source)
        used.update(suited_windows(windows, segment.rate))
        yield segment


def _probed(
    segments: Iterable[Segment], model: RobotModel, probes: list[Samples]
) -> Iterator[Segment]:
    """Pass stretches on and keep unfiltered samples at few of their instants."""
    for segment in segments:
        stride = max(1, int(PROBE_PERIOD * segment.rate))
        readings = smoothed(segment, LowPass(0))
        # Chosen by index, not by slice: a view would hold the whole stretch in memory.
        few = np.arange(0, len(readings), stride)
        probes.append(at_base(readings[few], model))
        yield segment
