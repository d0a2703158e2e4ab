"""From a log to information: alignment, filtering, and rows that are folded as they come."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from symbid_ros.arrays import concatenated
from symbid_ros.diagnosis.findings import Finding
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.group_moments import BY_SECONDS, Grouping
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.folding_pool import FoldingPool, available_cores, read_ahead
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.segment_store import SegmentStore
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align_checked, warn_once
from symbid_ros.signals.filters import LowPass, SavitzkyGolay, Smoothing, row_inflation
from symbid_ros.signals.log import Log
from symbid_ros.signals.sampled_rows import RowBuilder, sampled_rows
from symbid_ros.signals.segments import (
    WALL_CLOCK,
    RemoteSegments,
    Segment,
    cut_to,
    fingerprint,
    shift_behind,
)
from symbid_ros.signals.sensor_noise import MOTION, Channel
from symbid_ros.signals.sensor_samples import PROBE_PERIOD, build_samples, probed
from symbid_ros.signals.weak_form import (
    ALL_WINDOWS,
    BLOCK,
    block_rows,
    check_windows,
    cut_into_blocks,
    equation_rows,
    suitable_windows,
)

# Slices are whole blocks, and no window crosses a block, so the cuts do not change the results.
SPAN = 15 * BLOCK
# Bytes of aligned channels that are kept in memory: 45 s of the Symbitron.
MOST_KEPT = 16 << 20
# Instants at which unfiltered samples are kept; beyond, every second one is dropped, again and
# again, so that long logs take no more memory.
MOST_PROBES = 12_000

logger = logging.getLogger(__name__)


class AlignedLog:
    """The segments of a log in which every sensor has data; iterate as often as needed.

    The log is read once.

    Parameters
    ----------
    log : Log
        Read slice by slice.
    model : RobotModel
        Kinematics and frames.
    span : int
        Length of a slice, ns; one slice is in memory at a time.
    most_kept : int
        Bytes of segments that are kept in memory; those beyond are kept in a temporary file, and
        read from the log again only if there is no room for one.
    checks : StreamChecks, optional
        Receives every slice when it is first read. It reports faults of the streams; reading then
        logs only what is left out.
    watch : callable, optional
        Receives every segment when it is first read.
    jobs : int
        With more than one, the next segment is read by a thread while one is used.
    warns : bool
        Whether faults and what is left out are logged.

    Raises
    ------
    BagError, DataError, ModelError
        While iterating, when a bag, its data or the model is invalid.
    """

    def __init__(
        self,
        log: Log,
        model: RobotModel,
        *,
        span: int = SPAN,
        most_kept: int = MOST_KEPT,
        checks: StreamChecks | None = None,
        watch: Callable[[Segment], None] | None = None,
        jobs: int = 1,
        warns: bool = True,
    ) -> None:
        self._log, self._model = log.of_robot(model), model
        self._span, self._most_kept = span, most_kept
        self._checks, self._watch, self._jobs = checks, watch, jobs
        self._warns = warns
        self._kept: SegmentStore | None = None
        self._has_been_read = False

    def __iter__(self) -> Iterator[Segment]:
        if self._kept is not None:
            yield from self._kept
            return
        kept: SegmentStore | None = SegmentStore(self._most_kept)
        segments = self._read(warn=self._warns and not self._has_been_read)
        for segment in read_ahead(segments) if self._jobs > 1 else segments:
            if self._watch is not None and not self._has_been_read:
                self._watch(segment)
            try:
                if kept is not None:
                    kept.add(segment)
            except OSError as error:
                logger.info("%s: the log is read again for each step", error)
                kept = None
            yield segment
        self._has_been_read = True
        self._kept = kept

    def contiguous_segments(self) -> tuple[Segment, ...]:
        """Return all segments, those that continue one another joined."""
        return joined_segments(self)

    def _read(self, *, warn: bool) -> Iterator[Segment]:
        checks = self._checks if warn else None
        reports = warn and checks is None
        coverage = _Coverage(self._log.source)
        reported: set[tuple[str, str]] = set()
        with warn_once(muted=not reports):
            for piece in self._log.slices(self._span, warn=reports):
                if checks is not None:
                    checks.take(piece)
                if piece.streams is None:
                    coverage.lose(DataError(piece.fault, "E520"))
                    continue
                streams, findings = mask_faulty_messages(piece.streams)
                if reports:
                    _warn_once(findings, reported)
                try:
                    segments = align_checked(streams, self._model)
                except DataError as error:
                    coverage.lose(error)
                    continue
                for segment in cut_to(segments, piece.start, piece.stop):
                    coverage.take(segment, piece.recording)
                    yield segment
        coverage.check(warn=warn)


class ChainedSegments:
    """Segments of several logs, in the order of time.

    A log of a simulated clock that overlaps with one before it is moved behind all of those.

    Parameters
    ----------
    logs : sequence of iterables of Segment

    Attributes
    ----------
    spans : list of (int, int)
        First and last stamp of each moved log, in the order given, ns.

    Raises
    ------
    DataError
        When stamps of a wall clock overlap.
    """

    def __init__(self, logs: Sequence[Iterable[Segment]]) -> None:
        self.spans = spans = list[tuple[int, int]]()
        shifts, seconds = [], set[int]()
        for log in logs:
            own, ends = set[int](), list[tuple[int, int]]()
            for one in log:
                ends.append((int(one.stamp[0]), int(one.stamp[-1])))
                own |= fingerprint(one)
            (start, _), (_, stop), shift = ends[0], ends[-1], 0
            if any(start <= last and first <= stop for first, last in spans):
                if start >= WALL_CLOCK:
                    raise DataError(
                        "the stamps of two logs overlap, so that their payloads cannot be told "
                        "apart; record one after the other, with a clock that goes on, or identify "
                        "one of them without `drive_gain`, and give its `information` with the "
                        "other",
                        "E530",
                    )
                if again := seconds & own:
                    raise DataError(
                        f"{len(again)} s of two logs are the same; leave copies out", "E530"
                    )
                shift = shift_behind(start, max(last for _, last in spans))
            seconds |= own
            shifts.append(shift)
            spans.append((start + shift, stop + shift))
        order = sorted(range(len(logs)), key=lambda index: spans[index])
        self._logs = [(logs[index], shifts[index]) for index in order]

    def __iter__(self) -> Iterator[Segment]:
        for log, shift in self._logs:
            for segment in log:
                yield replace(segment, stamp=segment.stamp + shift) if shift else segment


def joined_segments(segments: Iterable[Segment]) -> tuple[Segment, ...]:
    """Return segments, those that continue one another joined."""
    joined: list[Segment] = []
    for segment in segments:
        if joined and joined[-1].is_continued_by(segment):
            joined[-1] = concatenated([joined[-1], segment])
        else:
            joined.append(segment)
    return tuple(joined)


@dataclass
class _Coverage:
    """How much of a log is in its segments."""

    source: str
    first: Segment | None = None
    last: int = 0
    instants: int = 0
    recording: int = 0
    paused: int = 0  # ns
    faults: list[DataError] = field(default_factory=list)

    def take(self, segment: Segment, recording: int) -> None:
        if recording != self.recording and self.first is not None:
            self.paused += int(segment.stamp[0]) - self.last - round(1e9 / segment.rate)
        self.recording = recording
        if self.first is None:
            self.first = segment
        elif segment.frames != self.first.frames:
            raise DataError(
                f"{self.source}: header.frame_id of a sensor changes from "
                f"{', '.join(self.first.frames)} to {', '.join(segment.frames)}; give each run "
                "separately",
                "E233",
            )
        self.last = int(segment.stamp[-1])
        self.instants += len(segment)

    def lose(self, fault: DataError) -> None:
        self.faults.append(fault)

    def check(self, *, warn: bool) -> None:
        """Raise an error if there is no segment; otherwise log what is left out."""
        if self.first is None:
            raise (
                self.faults[0]
                if self.faults
                else DataError(
                    f"{self.source}: no data in the requested part; give an earlier `start`", "E519"
                )
            )
        if not warn:
            return
        for fault in self.faults[:1]:
            count = len(self.faults)
            left_out = "a slice of the log is" if count == 1 else f"{count} slices of the log are"
            logger.warning("%s; %s left out", fault, left_out)
        length = (self.last - int(self.first.stamp[0]) - self.paused) * 1e-9
        expected = round(length * self.first.rate) + 1
        ends = 1 + self.recording  # where resampling may lose an instant
        if self.instants < expected - ends:
            logger.warning(
                "%s: %d of %d instants lie in gaps and are left out",
                self.source,
                expected - self.instants,
                expected,
            )


def _warn_once(findings: Iterable[Finding], reported: set[tuple[str, str]]) -> None:
    """Log once for each kind and topic that its messages are left out."""
    for finding in findings:
        if (finding.kind.value, finding.stream) not in reported:
            reported.add((finding.kind.value, finding.stream))
            logger.warning("%s; those messages are left out", finding.message)


SAMPLES_AT_ONCE = 1024  # samples whose rows are built at once


@dataclass(frozen=True)
class Processing:
    """How a log becomes rows.

    Attributes
    ----------
    smoothing : Smoothing or None
        Filter and differentiator for rows at single instants; None averages rows over windows.
    windows : tuple of float
        Window lengths to try, s; a log uses the shortest that suit its rate.
    full_rate : bool
        Whether every sample has a row before averaging.
    jobs : int
        Threads that build and fold rows averaged over windows.
    first : int or None
        First stamp of the log, ns, if the segments are a part of it; from there on, noise is
        replayed in fewer and fewer blocks. None if they start with it.
    grouping : Grouping
        Which rows are left out together when terms are judged by the rows that they predict.
    """

    smoothing: Smoothing | None = None
    windows: tuple[float, ...] = ALL_WINDOWS
    full_rate: bool = False
    jobs: int = field(default=1, compare=False)
    first: int | None = field(default=None, compare=False)
    grouping: Grouping = BY_SECONDS

    @classmethod
    def of(cls, options: IdentifyOptions) -> "Processing":
        """Return the processing that the options choose."""
        if options.row_filter == "weak":
            windows = ALL_WINDOWS if options.window is None else (options.window,)
            return cls(None, windows, options.full_rate, options.jobs or available_cores())
        if options.row_filter == "savitzky_golay":
            return cls(SavitzkyGolay(options.window or SavitzkyGolay.window))
        low_pass = LowPass() if options.cutoff is None else LowPass(options.cutoff)
        return cls(replace(low_pass, channels=options.channels or low_pass.channels))

    def __str__(self) -> str:
        """Return the description for a report."""
        if self.smoothing is not None:
            return str(self.smoothing)
        if self.windows == ALL_WINDOWS:
            return "rows averaged over Hann windows of the most informative length"
        lengths = " or ".join(f"{1e3 * window:g}" for window in self.windows)
        return f"rows averaged over Hann windows of {lengths} ms"


@dataclass(frozen=True)
class Dataset:
    """A log, read and folded.

    Attributes
    ----------
    source : str
        Name of the log, for messages.
    segments : iterable of Segment
        Aligned sensor channels, unfiltered.
    samples : Samples
        Filtered motion and forces; of rows that are averaged over windows, unfiltered ones at few
        instants.
    observations : tuple of Observations
        The folded rows for each window length.
    spans : tuple of tuple of (int, int)
        First and last stamp of each part without a gap, ns; empty if they are unknown.
    """

    source: str
    segments: Iterable[Segment]
    samples: Samples
    observations: tuple[Observations, ...]
    spans: tuple[tuple[int, int], ...] = ()


class DistributedSegments(RemoteSegments):
    """The segments of a log on other machines, which fold its rows there."""

    @abstractmethod
    def fold(self, source: str, parameters: ParameterSet, processing: Processing) -> Dataset:
        """Return what :func:`fold_dataset` does."""


def read_dataset(
    log: Log,
    parameters: ParameterSet,
    processing: Processing | None = None,
    checks: StreamChecks | None = None,
    watch: Callable[[Segment], None] | None = None,
) -> Dataset:
    """Read a log slice by slice and fold its rows.

    ``checks`` receives every slice, and ``watch`` every segment.

    Raises
    ------
    BagError, DataError, ModelError
        When a bag, its data or the model is invalid.
    """
    processing = processing or Processing()
    jobs = processing.jobs
    aligned = AlignedLog(log, parameters.model, checks=checks, watch=watch, jobs=jobs)
    segments = aligned if processing.smoothing is None else aligned.contiguous_segments()
    return fold_dataset(segments, log.source, parameters, processing)


def fold_dataset(
    segments: Iterable[Segment],
    source: str,
    parameters: ParameterSet,
    processing: Processing,
) -> Dataset:
    """Fold the rows of segments from a log named ``source``.

    Raises
    ------
    DataError, ModelError
        When the data or the model is invalid.
    """
    if isinstance(segments, DistributedSegments):
        return segments.fold(source, parameters, processing)
    model, smoothing = parameters.model, processing.smoothing
    if smoothing is None:
        layout = RowLayout.of(parameters)
        probes = Probes(model)
        windows = processing.windows
        used: set[float] = set()
        checked = _check_rates(segments, windows, source, used)
        observations = observe(
            probes.watch(checked),
            equation_rows(parameters),
            layout,
            windows,
            candidates=parameters.candidates,
            full_rate=processing.full_rate,
            jobs=processing.jobs,
            first=processing.first,
            grouping=processing.grouping,
        )
        samples, spans = concatenated(probes.parts), tuple(probes.spans)
        observations = tuple(one for one in observations if one.rows.samples > 0)
        if not observations:
            raise DataError(
                f"{source}: no part between two gaps is long enough for a window of "
                f"{1e3 * min(used):g} ms and its filter; record longer",
                "E521",
            )
    else:
        segments = tuple(segments)
        spans = tuple((int(one.stamp[0]), int(one.stamp[-1])) for one in segments)
        samples = build_samples(segments, model, smoothing, source)
        inflation = row_inflation(smoothing, segments[0].rate)
        rows = (sampled_rows(parameters, block) for block in samples.blocks(SAMPLES_AT_ONCE))
        unwindowed = Observations.unwindowed(RowLayout.of(parameters), rows, inflation)
        observations = (unwindowed.covering(frozenset().union(*map(fingerprint, segments))),)
    return Dataset(source, segments, samples, observations, spans)


def observe(
    segments: Iterable[Segment],
    build: RowBuilder,
    layout: RowLayout,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
    *,
    candidates: bool = False,
    full_rate: bool = False,
    jobs: int = 1,
    first: int | None = None,
    grouping: Grouping = BY_SECONDS,
) -> tuple[Observations, ...]:
    """Fold the windowed rows of aligned segments, for each window length.

    Each segment adds rows for the window lengths that suit its rate; others may stay empty.
    ``candidates`` tells whether the rows are those of candidate terms, ``full_rate`` whether every
    sample has a row before averaging, and ``jobs`` how many threads build and fold rows. ``first``
    is the first stamp of the log, ns, by default that of the first segment.
    """
    empty = {
        window: Observations.empty(layout, window, candidates=candidates, grouping=grouping)
        for window in windows
    }
    with FoldingPool(empty, jobs) as pool:
        for segment in segments:
            first = int(segment.stamp[0]) if first is None else first
            used = suitable_windows(windows, segment.rate)
            build_rows = partial(block_rows, full_rate=full_rate, first=first)
            for block in cut_into_blocks(segment):
                pool.submit(used, build_rows, block, build, used, noisy_channels)
            pool.cover(used, fingerprint(segment))
        return pool.finish()


def _check_rates(
    segments: Iterable[Segment], windows: Sequence[float], source: str, used: set[float]
) -> Iterator[Segment]:
    """Yield the segments and collect the window lengths that suit them; refuse rates too low."""
    for segment in segments:
        check_windows(windows, segment.rate, source)
        used.update(suitable_windows(windows, segment.rate))
        yield segment


@dataclass
class Probes:
    """Unfiltered samples at few instants of segments that pass by, and the spans of these."""

    model: RobotModel
    parts: list[Samples] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)
    _period: float = PROBE_PERIOD

    def watch(self, segments: Iterable[Segment]) -> Iterator[Segment]:
        """Yield the segments and collect samples."""
        for segment in segments:
            start, stop = int(segment.stamp[0]), int(segment.stamp[-1])
            if self.spans and (start - self.spans[-1][1]) * segment.rate < 1.5e9:
                start = self.spans.pop()[0]
            self.spans.append((start, stop))
            self.parts.append(probed(segment, self.model, self._period))
            if sum(map(len, self.parts)) > MOST_PROBES:
                self._period *= 2
                self.parts = [one[np.arange(0, len(one), 2)] for one in self.parts]
            yield segment
