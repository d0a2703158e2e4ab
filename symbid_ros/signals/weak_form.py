"""Rows of the equation of motion averaged over smooth windows, and how noisy they are.

The equation of motion holds at every instant, so it holds for any average of instants, and
one smooth window takes the noise out of both of its sides alike. By summation by parts the
average needs no acceleration: Σ w A q̈ = -Σ Δ(w A)/Δt q̇, exactly, where the differences are
central ones and the window ends at zero (``docs/theory.md``).

What noise does to the regressor is seen by adding as much again: the level of every
differentiated channel's noise shows in the quietest part of its spectrum. The difference that
it makes is averaged over the same windows.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows, equation_of_motion, is_slipping
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.noise_floor import MOTION, Channel, with_more_noise
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples, at_base, smoothed

# Seconds. Short windows follow brisk motion, long ones leave less noise in the regressor of calm
# motion; which of them serves a log best is decided by the data.
WINDOWS = (0.081, 0.161, 0.321)
# Slowly sampled logs use longer ones: the first three lengths that hold enough samples.
ALL_WINDOWS = (*WINDOWS, 0.641, 1.281, 2.561)
MOST_WINDOWS = len(WINDOWS)
# Fewer samples describe neither a Hann window nor the noise that it leaves (docs/theory.md).
SAMPLES_PER_WINDOW = 6

# Windows and filters never cross a multiple of the block's length, in ns of header.stamp: a log
# can be cut there and processed piece by piece without changing the result.
BLOCK = 4_000_000_000
# Slowly sampled logs have longer blocks, so that the edges of the filter stay a small part of
# them: the shortest of these with enough samples. All divide a minute, the length of a slice.
BLOCKS = (BLOCK, 12_000_000_000, 20_000_000_000)
SAMPLES_PER_BLOCK = 280

# Neighbouring Hann windows, half overlapped, share a sixth of white noise's variance; information
# counted as if they shared none is too much by 1 + 2/6.
INFLATION = 4 / 3

# A low-pass before differentiation, in Hz: far above what the windows let through, low enough that
# the squares of noisy rates add nothing. It is a share of the rate, within these limits.
PREFILTER = 100.0
SLOWEST_PREFILTER = 20.0
PREFILTER_SHARE = 0.1
# Below 80 Hz differences of samples amplify noise so little that a larger share may pass.
LARGEST_SHARE = 0.25

# Periods of the low-pass's cutoff that are left out at the ends of a block. What a filter does
# at an edge dies out by a factor of 80 in one period, and acceleration shows it most.
SETTLING = 4

# A joint row counts where the joint slipped for this share of the window.
SLIPPING = 0.95

CHUNK = 512


@dataclass(frozen=True)
class SampledRows:
    """Rows at single instants.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    rows : Rows
        N of them.
    valid : (N, n) bool
        Coordinates at which the equation holds; not where a joint may stick.
    """

    stamp: IntArray
    rows: Rows
    valid: BoolArray


RowBuilder = Callable[[SensorSamples], Iterator[SampledRows]]


@dataclass(frozen=True)
class WindowedRows:
    """Averages over windows.

    Attributes
    ----------
    mean : Rows
        The equation of motion, averaged. Coordinates that must not be used are zero.
    noise : Rows
        By how much they differ when the channels whose noise enters the regressor have it twice.
    valid : (N, n) bool
        Which coordinates are used.
    stamp : (N,) int64
        Middles of the windows, ns.
    """

    mean: Rows
    noise: Rows
    valid: BoolArray
    stamp: IntArray


def equation_rows(parameters: ParameterSet) -> RowBuilder:
    """Return what builds the rows of a robot's parameters from readings."""

    def build(readings: SensorSamples) -> Iterator[SampledRows]:
        model = parameters.model
        for start in range(0, len(readings), CHUNK):
            yield sampled_rows(parameters, at_base(readings[start : start + CHUNK], model))

    return build


def sampled_rows(parameters: ParameterSet, samples: Samples) -> SampledRows:
    """Return the equation of motion at single instants, and where it holds."""
    return valid_rows(
        samples.stamp,
        equation_of_motion(parameters, samples),
        sticking_left_out(parameters, samples.velocity),
    )


def valid_rows(stamp: IntArray, rows: Rows, valid: BoolArray) -> SampledRows:
    """Return rows that hold at some coordinates (N, n), less those whose force nobody measured."""
    measured = np.isfinite(rows.y)
    if measured.all():
        return SampledRows(stamp, rows, valid)
    return SampledRows(stamp, Rows(rows.K, np.where(measured, rows.y, 0.0)), valid & measured)


def sticking_left_out(parameters: ParameterSet, velocity: FloatArray) -> BoolArray:
    """Return which coordinates (N, n) obey Coulomb's law at joint rates (N, J).

    All joints do whose Coulomb friction is neither identified nor known. A joint that follows
    another has no row of its own.
    """
    model = parameters.model
    valid = np.ones((len(velocity), model.dof), dtype=bool)
    if "coulomb" in parameters.terms:
        valid[:, 6 * model.floating :] = is_slipping(velocity)
    elif "coulomb" in parameters.known_terms:
        rubs = parameters.known_terms["coulomb"] != 0
        valid[:, 6 * model.floating :] = is_slipping(velocity) | ~rubs
    valid[:, [6 * model.floating + joint for joint in model.followers]] = False
    return valid


def suited_windows(windows: Sequence[float], rate: float) -> tuple[float, ...]:
    """Return the shortest of some lengths, s, that hold enough samples at a rate, Hz."""
    return tuple(one for one in windows if one * rate >= SAMPLES_PER_WINDOW)[:MOST_WINDOWS]


def check_windows(windows: Sequence[float], rate: float, source: str) -> None:
    """Refuse a rate, Hz, at which no window holds enough samples; ``source`` is for the message.

    Raises
    ------
    DataError
        When there is none.
    """
    if suited_windows(windows, rate):
        return
    lengths = ", ".join(f"{1e3 * window:g}" for window in windows)
    raise DataError(
        f"{source}: windows of {lengths} ms hold fewer than {SAMPLES_PER_WINDOW} samples at "
        f"{rate:.4g} Hz; give a window of at least {SAMPLES_PER_WINDOW / rate:.3g} s, or record "
        "at a higher rate",
        "E319",
    )


def block_length(rate: float) -> int:
    """Return the length of blocks, ns, at a rate, Hz."""
    for length in BLOCKS:
        if length * 1e-9 * rate >= SAMPLES_PER_BLOCK:
            return length
    return BLOCKS[-1]


def prefilter(rate: float) -> tuple[LowPass, int]:
    """Return the low-pass for a rate, Hz, and the readings at either end that feel the edge."""
    least = min(SLOWEST_PREFILTER, LARGEST_SHARE * rate)
    low_pass = LowPass(min(PREFILTER, max(PREFILTER_SHARE * rate, least)), passes=1)
    return low_pass, int(np.ceil(SETTLING * rate / low_pass.cutoff))


def windowed_rows(
    segment: Segment,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
) -> Iterator[tuple[WindowedRows, ...]]:
    """Yield a stretch's rows block by block, for each length of window.

    Parameters
    ----------
    segment : Segment
        Uniformly sampled sensor channels.
    build : callable
        Makes rows of readings, such as :func:`equation_rows`.
    windows : sequence of float
        Lengths in s.
    noisy_channels : sequence of str
        Whose noise enters the regressor; none for half the time and its bias.
    """
    low_pass, edge = prefilter(segment.rate)
    blocks = segment.stamp // block_length(segment.rate)
    edges = np.searchsorted(blocks, np.arange(blocks[0], blocks[-1] + 2))
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if stop - start <= 2 * edge + 1:
            continue
        block = segment.cut(start, stop)
        readings = smoothed(block, low_pass, edge)
        centres = _centres(readings, windows)
        weights = [_hann(readings, *window) for window in zip(centres, windows, strict=True)]
        mean = noisy = _averages(build(readings), weights)
        if noisy_channels:
            more = smoothed(with_more_noise(block, noisy_channels), low_pass, edge)
            noisy = _averages(build(more), weights)
        stamps = [readings.stamp[0] + np.rint(1e9 * each).astype(np.int64) for each in centres]
        yield tuple(_combined(*parts) for parts in zip(mean, noisy, stamps, strict=True))


def _centres(readings: SensorSamples, windows: Sequence[float]) -> list[FloatArray]:
    """Return the middles of half overlapping windows, s after the first reading."""
    last = (readings.stamp[-1] - readings.stamp[0]) * 1e-9
    return [np.arange(length / 2, last - length / 2 + 1e-9, length / 2) for length in windows]


def _hann(readings: SensorSamples, centres: FloatArray, length: float) -> csr_array:
    """Return the weights (W, N) of readings in Hann windows about the centres (W,), s."""
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    first = np.searchsorted(time, centres - length / 2, side="right")
    last = np.searchsorted(time, centres + length / 2, side="left")
    rows = np.repeat(np.arange(len(centres)), last - first)
    ends = np.cumsum(last - first)
    columns = np.arange(ends[-1] if len(ends) else 0)
    columns = columns - np.repeat(ends - (last - first) - first, last - first)
    values = np.cos(np.pi * (time[columns] - centres[rows]) / length) ** 2
    total = np.bincount(rows, values, minlength=len(centres))
    values /= total[rows]
    return csr_array((values, (rows, columns)), shape=(len(centres), len(time)))


@dataclass(frozen=True)
class _Average:
    """Sums over windows: flat [K y] (W, n p + n), share of valid weight (W, n), and (n, p)."""

    flat: FloatArray
    valid: FloatArray
    shape: tuple[int, int]


def _averages(parts: Iterator[SampledRows], weights: Sequence[csr_array]) -> list[_Average]:
    sums: list[_Average] = []
    start = 0
    for part in parts:
        count, n, p = part.rows.K.shape
        flat = np.concatenate([part.rows.K.reshape(count, n * p), part.rows.y], axis=1)
        columns = slice(start, start + count)
        terms = [
            _Average(weight[:, columns] @ flat, weight[:, columns] @ part.valid, (n, p))
            for weight in weights
        ]
        sums = terms if not sums else [_added(a, b) for a, b in zip(sums, terms, strict=True)]
        start += count
    return sums


def _added(a: _Average, b: _Average) -> _Average:
    return _Average(a.flat + b.flat, a.valid + b.valid, a.shape)


def _combined(mean: _Average, noisy: _Average, stamp: IntArray) -> WindowedRows:
    n, p = mean.shape
    valid = mean.valid > SLIPPING

    def rows(flat: FloatArray) -> Rows:
        K, y = flat[:, : n * p].reshape(-1, n, p), flat[:, n * p :]
        return Rows(K * valid[:, :, None], y * valid)

    return WindowedRows(rows(mean.flat), rows(noisy.flat - mean.flat), valid, stamp)
