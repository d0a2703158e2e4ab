"""From bags to information: everything that happens before a method is chosen."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.bags.streams.selection import TopicSelection
from symbid_ros.bags.streams.slices import ALL_OF_IT, TimeRange
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.layout import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.sensor_log import SensorLog
from symbid_ros.signals.alignment import Segment
from symbid_ros.signals.filters import (
    Channels,
    LowPass,
    SavitzkyGolay,
    Smoothing,
    row_inflation,
)
from symbid_ros.signals.fingerprint import fingerprint
from symbid_ros.signals.noise_floor import MOTION, Channel
from symbid_ros.signals.readings import at_base, smoothed
from symbid_ros.signals.samples import build_samples, joined
from symbid_ros.signals.weak_form import (
    WINDOWS,
    RowBuilder,
    equation_rows,
    sampled_rows,
    windowed_rows,
)

Filter = Literal["weak", "butterworth", "savitzky_golay"]

BLOCK = 1024  # samples whose rows are built at once

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
        Lengths of those windows to try, s.
    topics : TopicSelection
        Which topics are the robot's sensors.
    part : TimeRange
        Which part of the log.
    """

    smoothing: Smoothing | None = None
    windows: tuple[float, ...] = WINDOWS
    topics: TopicSelection = field(default_factory=TopicSelection)
    part: TimeRange = ALL_OF_IT

    def __str__(self) -> str:
        """Return what a report says of it."""
        if self.smoothing is not None:
            return str(self.smoothing)
        lengths = " or ".join(f"{1e3 * window:g}" for window in self.windows)
        return f"rows averaged over Hann windows of {lengths} ms"


def processing(
    name: Filter,
    window: float | None,
    cutoff: float | None,
    channels: Channels | None,
    topics: TopicSelection,
    *,
    part: TimeRange = ALL_OF_IT,
) -> Processing:
    """Return the processing that options ask for; None leaves them as they are by default.

    Raises
    ------
    DataError
        When a window or cutoff is none, or an option has no meaning for this processing.
    """
    if window is not None and not 0 < window < np.inf:
        raise DataError(f"a window of {window:g} s is none; give a positive length")
    if name != "butterworth" and (cutoff is not None or channels is not None):
        raise DataError(
            f"{name} has neither cutoff nor channels; give --filter butterworth, or leave --cutoff "
            "and --channels out"
        )
    if name == "butterworth":
        if window is not None:
            raise DataError("butterworth has no window; give a cutoff, or another filter")
        filtered = LowPass() if cutoff is None else LowPass(cutoff)
        smoothing: Smoothing = replace(filtered, channels=channels or filtered.channels)
        return Processing(smoothing, topics=topics, part=part)
    if name == "savitzky_golay":
        smoothing = SavitzkyGolay(window or SavitzkyGolay.window)
        return Processing(smoothing, topics=topics, part=part)
    windows = WINDOWS if window is None else (window,)
    return Processing(windows=windows, topics=topics, part=part)


@dataclass(frozen=True)
class Record:
    """One recording, read and folded.

    Attributes
    ----------
    bags : tuple of Path
        Where it came from.
    segments : iterable of Segment
        Aligned sensor channels, as they were recorded; a long log is read again for them.
    samples : Samples
        Motion and forces after filtering, at instants far enough apart to be few.
    observations : tuple of Observations
        The rows, folded, for each length of window.
    """

    bags: tuple[Path, ...]
    segments: Iterable[Segment]
    samples: Samples
    observations: tuple[Observations, ...]


def read_record(
    bags: Sequence[Path],
    parameters: ParameterSet,
    processing: Processing | None = None,
    checks: StreamChecks | None = None,
) -> Record:
    """Read bags piece by piece, build samples and fold their rows.

    ``checks`` takes the streams on the way.

    Raises
    ------
    BagError, DataError, ModelError
        When a bag, its data or the model does not serve; the message says which.
    """
    processing = processing or Processing()
    log = SensorLog(bags, parameters.model, processing.topics, processing.part, checks=checks)
    segments = log if processing.smoothing is None else log.whole_stretches()
    return fold_record(segments, bags, parameters, processing)


def fold_record(
    segments: Iterable[Segment],
    bags: Sequence[Path],
    parameters: ParameterSet,
    processing: Processing,
) -> Record:
    """Do the same with stretches that have been read from these bags.

    Raises
    ------
    DataError, ModelError
        When the data or the model does not serve; the message says which.
    """
    model, smoothing = parameters.model, processing.smoothing
    source = ", ".join(map(str, bags))
    if smoothing is None:
        layout = RowLayout.of(parameters)
        probes: list[Samples] = []
        observations = observe(
            _probed(segments, model, probes), equation_rows(parameters), layout, processing.windows
        )
        samples = joined(probes)
        observations = tuple(one for one in observations if one.rows.samples > 0)
        if not observations:
            raise DataError(
                f"{source}: the log is too short, not even a window of "
                f"{1e3 * min(processing.windows):g} ms fits into it; record longer"
            )
    else:
        stretches = tuple(segments)
        samples = build_samples(stretches, model, smoothing, source)
        inflation = row_inflation(smoothing, stretches[0].rate)
        rows = (sampled_rows(parameters, block) for block in samples.blocks(BLOCK))
        unwindowed = Observations.unwindowed(RowLayout.of(parameters), rows, inflation)
        observations = (unwindowed.covering(frozenset().union(*map(fingerprint, stretches))),)
        segments = stretches
    return Record(tuple(bags), segments, samples, observations)


def observe(
    segments: Iterable[Segment],
    build: RowBuilder,
    layout: RowLayout,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
) -> tuple[Observations, ...]:
    """Fold the windowed rows of aligned segments, for each length of window."""
    observations = [Observations.empty(layout, window) for window in windows]
    for segment in segments:
        for blocks in windowed_rows(segment, build, windows, noisy_channels):
            observations = [
                one.fold([block]) for one, block in zip(observations, blocks, strict=True)
            ]
        covered = fingerprint(segment)
        observations = [one.covering(covered) for one in observations]
    return tuple(observations)


def _probed(
    segments: Iterable[Segment], model: RobotModel, probes: list[Samples]
) -> Iterator[Segment]:
    """Pass stretches on and keep unfiltered samples at few of their instants."""
    for segment in segments:
        stride = max(1, int(PROBE_PERIOD * segment.rate))
        # Chosen by index, not by slice: a view would hold the whole stretch in memory.
        few = np.arange(0, len(segment), stride)
        probes.append(at_base(smoothed(segment, LowPass(0))[few], model))
        yield segment
