"""Rows of the equation of motion averaged over smooth windows, and their noise.

The equation of motion holds at every instant, so it holds for any weighted average. A smooth
window reduces the noise of both sides equally. With summation by parts the average needs no
acceleration: Σ w A q̈ = -Σ Δ(w A)/Δt q̇ exactly, for central differences and a window that ends at
zero (``docs/theory.md``).

The effect of noise on the regressor is measured by adding as much noise again
(:mod:`symbid_ros.signals.sensor_noise`). The resulting change of the rows is averaged over the same
windows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, IntArray
from symbid_ros.choices import SIMULATED_TERMS, SLIDING_TERMS
from symbid_ros.dynamics.friction import (
    coulomb_column,
    creeping_column,
    friction_state,
    leading_column,
)
from symbid_ros.dynamics.regressor import Rows, averaged_equation_of_motion, has_linear_rows
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.decimation import Decimator, decimation_stride
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sampled_rows import (
    RowBuilder,
    SampledRows,
    least_slipping,
    rows_that_hold,
    sampled_rows,
    samples_at_once,
)
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_noise import MOTION, Channel, add_noise
from symbid_ros.signals.sensor_samples import (
    RecordedPositions,
    SensorSamples,
    at_base,
    decimated,
    smoothed,
)
from symbid_ros.signals.window_averages import (
    Average,
    AveragingRows,
    average,
    averages_of,
    extended,
    hann_weights,
    stacked,
    window_centres,
)

# Seconds. Short windows resolve fast motion, long ones leave less noise in the regressor of slow
# motion. The best one for a log is selected from the data.
WINDOWS = (0.081, 0.161, 0.321)
# Logs with low sampling rates use the three shortest lengths that hold enough samples.
ALL_WINDOWS = (*WINDOWS, 0.641, 1.281, 2.561)
MOST_WINDOWS = len(WINDOWS)
# Fewer samples do not represent a Hann window and its residual noise (docs/theory.md).
SAMPLES_PER_WINDOW = 6

# Windows and filters never cross a multiple of the block's length, in ns of header.stamp: a log
# can be cut there and processed piece by piece without changing the result.
BLOCK = 4_000_000_000
# The shortest of these blocks with enough samples is used, so that the edges of the filter are a
# small part of it. All lengths divide a minute, the length of a slice.
BLOCKS = (BLOCK, 12_000_000_000, 20_000_000_000)
SAMPLES_PER_BLOCK = 280

# Averages of white noise over half-overlapping Hann windows have a correlation of 1/6. Counting
# neighbours as independent overestimates the information by 1 + 2/6.
INFLATION = 4 / 3

# Cutoff of the low-pass before differentiation, Hz: far above the passband of the windows, and low
# enough that squares of noisy rates are negligible. It is a share of the rate within these limits.
PREFILTER = 100.0
SLOWEST_PREFILTER = 20.0
PREFILTER_SHARE = 0.1
# Below 80 Hz, differentiation amplifies noise little, which allows a larger share.
LARGEST_SHARE = 0.25

# Periods of the low-pass's cutoff that are discarded at the ends of a block. The filter's transient
# decays by a factor of 80 per period and affects acceleration most.
SETTLING = 4

# Blocks from the start of a log whose noise is replayed. The replay estimates a mean, for which it
# is enough to replay every second, fourth and eighth block later on.
REPLAYED_BLOCKS = 8
MOST_DOUBLINGS = 3


@dataclass(frozen=True)
class WindowedRows:
    """Rows averaged over windows.

    Attributes
    ----------
    mean : Rows
        Averaged equation of motion; zero for invalid coordinates.
    noise : Rows or None
        Change of the rows when the noise that enters the regressor is added once more, times the
        square root of the number of blocks that this one represents; None if another does.
    valid : (N, n) bool
        Coordinates that are used.
    stamp : (N,) int64
        Centres of the windows, ns.
    slips : (N, n) bool or None
        Of candidate terms: valid coordinates except joints that may stick.
    """

    mean: Rows
    noise: Rows | None
    valid: BoolArray
    stamp: IntArray
    slips: BoolArray | None = None

    def slipping(self) -> "WindowedRows":
        """Return the same windows without the rows of joints that may stick."""
        return self if self.slips is None else replace(self.only(self.slips), slips=None)

    def only(self, some: BoolArray) -> "WindowedRows":
        """Return the same windows with the rows ``some`` (N, n) alone."""
        noise = None if self.noise is None else self.noise.masked(some)
        slips = None if self.slips is None else self.slips & some
        return WindowedRows(self.mean.masked(some), noise, self.valid & some, self.stamp, slips)


@dataclass(frozen=True)
class EquationRows(AveragingRows):
    """Builds rows in the robot's parameters."""

    parameters: ParameterSet

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        for part in self._samples(readings).blocks(samples_at_once(self.parameters)):
            yield sampled_rows(self.parameters, part)

    @property
    def skips_samples(self) -> bool:
        """Whether averages need no rows of single samples, and take few milliseconds."""
        return has_linear_rows(self.parameters)

    def averages(self, readings: SensorSamples, weights: Sequence[csr_array]) -> list[Average]:
        """Return averages over windows, without rows of single samples where that is possible."""
        parameters = self.parameters
        if not self.skips_samples:
            return average(self(readings), weights)
        samples = self._samples(readings)
        K, y = averaged_equation_of_motion(parameters, samples, stacked(weights))
        empty = Rows(np.empty((*y.shape, 0)), y)
        forces = average(iter([rows_that_hold(parameters, samples, empty)]), weights)
        return extended(forces, K)

    def _samples(self, readings: SensorSamples) -> Samples:
        parameters = self.parameters
        samples = at_base(readings, parameters.model)
        if not SLIDING_TERMS.isdisjoint((*parameters.terms, *parameters.known_terms)):
            samples = with_filtered_friction(samples, parameters, readings.recorded)
        return samples


def equation_rows(parameters: ParameterSet) -> EquationRows:
    """Return a builder of rows in the robot's parameters from sensor samples."""
    return EquationRows(parameters)


def with_filtered_friction(
    samples: Samples, parameters: ParameterSet, recorded: RecordedPositions | None = None
) -> Samples:
    """Return consecutive samples with dry friction that is filtered like the efforts.

    Friction changes its sign at once when a joint reverses. The efforts show this change after the
    low-pass, so the columns need the same filter; smooth columns do not. The reversals of samples
    at a lower rate are found in the positions ``recorded`` at the full rate.
    """
    if len(samples) < 2:
        return samples
    model, terms = parameters.model, parameters.terms
    if recorded is not None:
        low_pass, rate = replace(recorded.decimator, edge=0).force, recorded.decimator.rate
        position, velocity = recorded.motion()
        position = model.apply_mimics(position)
        velocity = model.apply_mimics(velocity, rates=True)
    else:
        rate = 1e9 / float(np.median(np.diff(samples.stamp)))
        low_pass = partial(prefilter(rate)[0].force, rate=rate)
        position, velocity = samples.position, samples.velocity
    samples = replace(samples, sliding=low_pass(coulomb_column(velocity, model.joints)))
    if "presliding" in terms:
        samples = replace(samples, friction_state=low_pass(friction_state(position, model.joints)))
    if not set(SIMULATED_TERMS).isdisjoint(terms):
        acceleration = np.gradient(velocity, 1 / rate, axis=0)
        ahead = leading_column(velocity, acceleration, model.joints)
        slow = creeping_column(velocity, acceleration, model.joints)
        samples = replace(samples, leading=low_pass(ahead), creeping=low_pass(slow))
    return samples


def suitable_windows(windows: Sequence[float], rate: float) -> tuple[float, ...]:
    """Return the shortest windows, s, that hold enough samples at a rate, Hz."""
    return tuple(one for one in windows if one * rate >= SAMPLES_PER_WINDOW)[:MOST_WINDOWS]


def check_windows(windows: Sequence[float], rate: float, source: str) -> None:
    """Raise an error if no window holds enough samples at a rate, Hz.

    Raises
    ------
    DataError
        When no window is long enough; the message starts with ``source``.
    """
    if suitable_windows(windows, rate):
        return
    lengths = ", ".join(f"{1e3 * window:g}" for window in windows)
    raise DataError(
        f"{source}: windows of {lengths} ms hold fewer than {SAMPLES_PER_WINDOW} samples at "
        f"{rate:.4g} Hz; use a window of at least {SAMPLES_PER_WINDOW / rate:.3g} s, or record "
        "at a higher rate",
        "E319",
    )


def holds_window(segment: Segment, windows: Sequence[float]) -> bool:
    """Return whether a segment is long enough for a row averaged over one of the windows, s."""
    _, edge = prefilter(segment.rate)
    return any(
        len(centres)
        for block in cut_into_blocks(segment)
        for centres in window_centres(
            int(block.stamp[-1 - edge] - block.stamp[edge]),
            suitable_windows(windows, segment.rate),
        )
    )


def block_length(rate: float) -> int:
    """Return the length of blocks, ns, at a rate, Hz."""
    for length in BLOCKS:
        if length * 1e-9 * rate >= SAMPLES_PER_BLOCK:
            return length
    return BLOCKS[-1]


def prefilter(rate: float) -> tuple[LowPass, int]:
    """Return the low-pass for a rate, Hz, and the number of samples at each end to discard."""
    least = min(SLOWEST_PREFILTER, LARGEST_SHARE * rate)
    low_pass = LowPass(min(PREFILTER, max(PREFILTER_SHARE * rate, least)), passes=1)
    return low_pass, int(np.ceil(SETTLING * rate / low_pass.cutoff))


def windowed_rows(
    segment: Segment,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
    *,
    full_rate: bool = False,
    first: int | None = None,
    shortest: float = WINDOWS[0],
) -> Iterator[tuple[WindowedRows, ...]]:
    """Yield a segment's rows block by block, for each window length.

    Parameters
    ----------
    segment : Segment
        Uniformly sampled sensor channels.
    build : callable
        Builds rows from sensor samples, such as :func:`equation_rows`.
    windows : sequence of float
        Window lengths, s.
    noisy_channels : sequence of str
        Channels whose noise enters the regressor. Empty halves the run time and leaves the bias.
    full_rate : bool
        Whether to build a row for every sample, although the low-pass leaves fewer that are
        independent.
    first : int, optional
        First stamp of the log, ns: noise is replayed in :func:`represented_blocks`. By default it
        is replayed in all.
    shortest : float
        Length of the shortest windows, s, for which the rate of the rows suffices.
    """
    build_rows = partial(block_rows, full_rate=full_rate, first=first, shortest=shortest)
    for block in cut_into_blocks(segment):
        yield build_rows(block, build, windows, noisy_channels)


def cut_into_blocks(segment: Segment) -> Iterator[Segment]:
    """Yield the parts of a segment in which the low-pass settles, none across a block's end."""
    _, edge = prefilter(segment.rate)
    blocks = segment.stamp // block_length(segment.rate)
    edges = np.searchsorted(blocks, np.arange(blocks[0], blocks[-1] + 2))
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if stop - start > 2 * edge + 1:
            yield segment.cut(start, stop)


def block_rows(
    block: Segment,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
    *,
    full_rate: bool = False,
    first: int | None = None,
    shortest: float = WINDOWS[0],
) -> tuple[WindowedRows, ...]:
    """Return the rows of a block, for each window length; see :func:`windowed_rows`."""
    low_pass, edge = prefilter(block.rate)
    decimator = _decimator(block.rate, low_pass, edge, min(shortest, *windows))

    def samples(of: Segment, similar: tuple[Segment, SensorSamples] | None) -> SensorSamples:
        return smoothed(of, low_pass, edge) if full_rate else decimated(of, decimator, similar)

    readings = samples(block, None)
    centres = window_centres(block.stamp[-1 - edge] - block.stamp[edge], windows)
    weights = [hann_weights(readings, *window) for window in zip(centres, windows, strict=True)]
    mean = averages_of(build, readings, weights)
    noisy: Sequence[Average | None] = [None] * len(mean)
    represented = 1
    if first is not None:
        length = block_length(block.rate)
        represented = represented_blocks(int(block.stamp[0]) // length - first // length)
    if noisy_channels and represented:
        more = samples(add_noise(block, noisy_channels), (block, readings))
        noisy = averages_of(build, more, weights)
    stamps = [readings.stamp[0] + np.rint(1e9 * each).astype(np.int64) for each in centres]
    found = tuple(
        _windowed_rows_of(one, other, stamp, window, represented)
        for one, other, stamp, window in zip(mean, noisy, stamps, windows, strict=True)
    )
    if block.stopped is None:
        return found
    return tuple(
        rows.only(free_of_stops(block, rows.stamp, window, one))
        for rows, window, one in zip(found, windows, mean, strict=True)
    )


def represented_blocks(index: int) -> int:
    """Return how many blocks the noise of a log's block represents; zero if it is not replayed.

    The first ``REPLAYED_BLOCKS`` represent themselves. As many are replayed of the next twice as
    many, and so on. One is replayed of each group, at places without a period, because the motion
    may repeat itself.

    Parameters
    ----------
    index : int
        Number of the block since the start of the log; before it all blocks are replayed.
    """
    if index < REPLAYED_BLOCKS:
        return 1
    doublings = min((1 + index // REPLAYED_BLOCKS).bit_length() - 1, MOST_DOUBLINGS)
    size = 1 << doublings
    group, place = divmod(index - REPLAYED_BLOCKS * (size - 1), size)
    return size if place == int(size * (group * np.sqrt(2) % 1)) else 0


def _decimator(rate: float, low_pass: LowPass, edge: int, shortest: float) -> Decimator:
    """Return what filters signals and reduces their rate as far as low-pass and windows allow."""
    stride = decimation_stride(rate, low_pass.cutoff, shortest)
    # The main lobe of a Hann window's spectrum ends at two over its length.
    return Decimator(rate, stride, low_pass, 2 / shortest, edge)


def _windowed_rows_of(
    mean: Average, noisy: Average | None, stamp: IntArray, window: float, represented: int
) -> WindowedRows:
    if mean.combined is not None:
        valid, slips = mean.combined.valid()
    else:
        least = least_slipping(window)
        valid = mean.valid > least
        slips = None if mean.slips is None else (mean.slips > least) & valid
    noise = None
    if noisy is not None:
        scale = np.sqrt(represented)
        noise = Rows(scale * (noisy.K - mean.K), scale * (noisy.y - mean.y)).masked(valid)
    return WindowedRows(Rows(mean.K, mean.y).masked(valid), noise, valid, stamp, slips)


def free_of_stops(block: Segment, stamp: IntArray, window: float, mean: Average) -> BoolArray:
    """Return which rows (W, n) no force of an end stop enters at any time of windows.

    The efforts are filtered, so the force is felt a little longer than the stop is touched.

    Parameters
    ----------
    block : Segment
    stamp : (W,) int64
        Centres of the windows, ns.
    window : float
        Their length, s.
    mean : Average
        Of the rows.
    """
    is_free = np.ones((len(stamp), mean.y.shape[1]), dtype=bool)
    if block.stopped is None:
        return is_free
    low_pass, _ = prefilter(block.rate)
    reach = round(1e9 * (window / 2 + 1 / low_pass.cutoff))
    first = np.searchsorted(block.stamp, stamp - reach)
    last = np.searchsorted(block.stamp, stamp + reach, side="right")
    before = np.cumsum(np.pad(block.stopped.astype(np.int64), ((1, 0), (0, 0))), axis=0)
    stopped = before[last] > before[first]
    joints = slice(is_free.shape[1] - stopped.shape[1], None)
    is_free[:, joints] = ~stopped
    contacts = None if mean.combined is None else mean.combined.model.contacts
    if contacts is not None:
        loaded = np.asarray(contacts.loads.any(axis=0))
        is_free[:, loaded] &= ~np.any(stopped & loaded[joints], axis=1, keepdims=True)
    return is_free
