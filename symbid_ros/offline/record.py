"""From bags to information: everything that happens before a method is chosen."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.bags.reader import read_streams
from symbid_ros.bags.selection import TopicSelection
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.layout import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import Segment
from symbid_ros.signals.filters import (
    Channels,
    LowPass,
    SavitzkyGolay,
    Smoothing,
    row_inflation,
)
from symbid_ros.signals.noise_floor import MOTION, Channel
from symbid_ros.signals.readings import at_base, smoothed
from symbid_ros.signals.samples import build_samples, joined, moving_segments
from symbid_ros.signals.streams import Streams
from symbid_ros.signals.weak_form import (
    WINDOWS,
    RowBuilder,
    equation_rows,
    sampled_rows,
    windowed_rows,
)

BLOCK = 1024  # samples whose rows are built at once

# Share of the expected weight by which forces may miss it before a plate is thought missing.
WEIGHT_TOLERANCE = 0.35
# Instants at which that is looked at, and sensor noise carried over to the rows.
PROBES = 1000


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
    """

    smoothing: Smoothing | None = None
    windows: tuple[float, ...] = WINDOWS
    topics: TopicSelection = field(default_factory=TopicSelection)

    def __str__(self) -> str:
        """Return what a report says of it."""
        if self.smoothing is not None:
            return str(self.smoothing)
        lengths = " or ".join(f"{1e3 * window:g}" for window in self.windows)
        return f"rows averaged over Hann windows of {lengths} ms"


def processing(
    name: Literal["weak", "butterworth", "savitzky_golay"],
    window: float | None,
    cutoff: float | None,
    channels: Channels | None,
    topics: TopicSelection,
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
        raise DataError(f"{name} has neither cutoff nor channels; ask for butterworth with these")
    if name == "butterworth":
        if window is not None:
            raise DataError("butterworth has no window; give a cutoff, or another filter")
        filtered = LowPass() if cutoff is None else LowPass(cutoff)
        return Processing(replace(filtered, channels=channels or filtered.channels), topics=topics)
    if name == "savitzky_golay":
        return Processing(SavitzkyGolay(window or SavitzkyGolay.window), topics=topics)
    return Processing(windows=WINDOWS if window is None else (window,), topics=topics)


@dataclass(frozen=True)
class Record:
    """One recording, read and folded.

    Attributes
    ----------
    bags : tuple of Path
        Where it came from.
    segments : tuple of Segment
        Aligned sensor channels, as they were recorded.
    samples : Samples
        Motion and forces after filtering, at instants far enough apart to be few.
    observations : tuple of Observations
        The rows, folded, for each length of window.
    """

    bags: tuple[Path, ...]
    segments: tuple[Segment, ...]
    samples: Samples
    observations: tuple[Observations, ...]


def read_record(
    bags: Sequence[Path], parameters: ParameterSet, processing: Processing | None = None
) -> Record:
    """Read bags, build samples and fold their rows.

    Raises
    ------
    BagError, DataError, ModelError
        When a bag, its data or the model does not serve; the message says which.
    """
    processing = processing or Processing()
    return fold_record(read_streams(bags, processing.topics), bags, parameters, processing)


def fold_record(
    streams: Streams, bags: Sequence[Path], parameters: ParameterSet, processing: Processing
) -> Record:
    """Do the same with streams that have been read from these bags.

    Raises
    ------
    DataError, ModelError
        When the data or the model does not serve; the message says which.
    """
    model, smoothing = parameters.model, processing.smoothing
    segments = moving_segments(streams, model)
    if smoothing is None:
        layout = RowLayout.of(parameters)
        observations = observe(segments, equation_rows(parameters), layout, processing.windows)
        samples = _probes(segments, model)
        observations = tuple(one for one in observations if one.rows.samples > 0)
        if not observations:
            raise DataError(
                f"{streams.source}: the log is too short, not even a window of "
                f"{1e3 * min(processing.windows):g} ms fits into it; record longer"
            )
    else:
        samples = build_samples(streams, model, smoothing)
        inflation = row_inflation(smoothing, segments[0].rate)
        rows = (sampled_rows(parameters, block) for block in samples.blocks(BLOCK))
        observations = (Observations.unwindowed(RowLayout.of(parameters), rows, inflation),)
    return Record(tuple(bags), segments, samples, observations)


def observe(
    segments: Sequence[Segment],
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
    return tuple(observations)


def _probes(segments: Sequence[Segment], model: RobotModel) -> Samples:
    """Return unfiltered samples at few instants."""
    stride = max(1, sum(map(len, segments)) // PROBES)
    return joined([at_base(smoothed(s, LowPass(0))[::stride], model) for s in segments])


def check_weight(record: Record, parameters: ParameterSet, prior: Prior) -> None:
    """Refuse a floating robot whose measured forces do not carry it.

    A forgotten plate leaves an equation of motion that is wrong by tens of percent, which no
    method notices by itself. Nothing is checked when the wrench topics were named
    by hand.

    Raises
    ------
    DataError
        When the base's force rows miss what the prior expects by more than
        ``WEIGHT_TOLERANCE`` times its weight.
    """
    model = parameters.model
    if not model.floating:
        return
    rows = record.observations[0].rows
    moment = rows.residual_moment(prior.mean).diagonal() / max(rows.samples, 1)
    weight = np.linalg.norm(model.gravity) * parameters.link_phi(prior.mean)[:, 0].sum()
    missing = np.sqrt(moment[3:6].sum()) / weight
    if missing > WEIGHT_TOLERANCE:
        bags = ", ".join(map(str, record.bags))
        frames = ", ".join(record.samples.wrench_frames) or "none"
        raise DataError(
            f"{bags}: the wrenches measured (frames: {frames}) differ by {100 * missing:.0f} % of "
            "the prior's weight from what the motion needs; record the wrench of every contact, or "
            "name the wrench topics yourself to go on with these"
        )
