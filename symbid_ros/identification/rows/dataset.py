"""From a log to information: filtering, and rows that are folded as they come."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from symbid_ros.arrays import concatenated
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.group_moments import BY_SECONDS, Grouping
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.identification.rows.folding_pool import FoldingPool, available_cores
from symbid_ros.identification.rows.reading_process import can_read_in_process
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import LowPass, SavitzkyGolay, Smoothing, row_inflation
from symbid_ros.signals.log import Log
from symbid_ros.signals.sampled_rows import RowBuilder, sampled_rows
from symbid_ros.signals.segments import RemoteSegments, Segment, fingerprint
from symbid_ros.signals.sensor_noise import MOTION, Channel
from symbid_ros.signals.sensor_samples import PROBE_PERIOD, build_samples, probed
from symbid_ros.signals.weak_form import (
    ALL_WINDOWS,
    block_rows,
    check_windows,
    cut_into_blocks,
    equation_rows,
    suitable_windows,
)

# Instants at which unfiltered samples are kept; beyond, every second one is dropped, again and
# again, so that long logs take no more memory.
MOST_PROBES = 12_000
# Width of flat rows from which folding them takes so much longer than reading the log that a core
# for the process that reads it would be idle.
WIDE = 2000
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
    in_process = processing.jobs > 1 and bool(log.files) and can_read_in_process()
    if in_process and RowLayout.of(parameters).width < WIDE:
        processing = replace(processing, jobs=processing.jobs - 1)
    aligned = AlignedLog(
        log,
        parameters.model,
        checks=checks,
        watch=watch,
        jobs=processing.jobs,
        in_process=in_process,
    )
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
        observations = tuple(one for one in observations if one.rows.samples > 0)
        if not observations:
            raise DataError(
                f"{source}: no part between two gaps is long enough for a window of "
                f"{1e3 * min(used or windows):g} ms and its filter; record longer",
                "E521",
            )
        samples, spans = concatenated(probes.parts), tuple(probes.spans)
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
    With ``candidates``, the rows have the columns of candidate terms; with ``full_rate``, every
    sample has a row before averaging. ``jobs`` threads build and fold rows. ``first``
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
