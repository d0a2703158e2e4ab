"""White noise of sensor channels: its level below motion, and noise of that level.

Between a tenth and a half of the sampling rate, motion rarely fills the whole spectrum. What is
left between its bands and harmonics is noise (``docs/theory.md``).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.decimation import power_spectrum
from symbid_ros.signals.segments import Segment

Channel = Literal["position", "angular_velocity", "effort", "wrenches", "linear_acceleration"]
# Channels whose noise enters the regressor. That of accelerometers is small compared with gravity,
# but not with the accelerations that tell masses where forces of contacts are unknown.
MOTION: tuple[Channel, ...] = ("position", "angular_velocity", "linear_acceleration")
# Channels whose noise also enters the columns of sensor gains.
FORCES: tuple[Channel, ...] = ("effort", "wrenches")
IMU_CHANNELS: tuple[Channel, ...] = ("angular_velocity", "linear_acceleration")

# The quietest of these equal bands, from this share of the rate up to half of it, is assumed to
# hold only noise. Vibration rarely fills all of them.
BANDS = 8
LOWEST = 0.1
# Highest frequency for sensors slower than this share of the clock's rate, as a share of their own
# rate: interpolation leaves nothing above half of it, and less just below.
SLOWER, HIGHEST = 0.9, 0.4
# Magnitude of the expected minimum of eight standard normal variables, for the quietest band.
LEAST_OF_BANDS = 1.4236
# At least this share of the powers is free of harmonics. Powers above this multiple of the mean are
# taken for harmonics, in this many passes.
QUIET, EXCISION, EXCISIONS = 0.2, 3.0, 6


def noise_deviation(
    channel: FloatArray, rate: float, measured_at: float | None = None
) -> FloatArray:
    """Return the standard deviation (c,) of the white noise in signals (N, c).

    The spectrum of white noise is flat, so its level in one quiet band holds for all bands. A
    periodic gait has harmonics in each of them, and its noise is the level between these.

    Parameters
    ----------
    channel : (N, c) float64
    rate : float
        Of the signals, Hz.
    measured_at : float, optional
        Lower rate from which they were interpolated, Hz. The deviation is then that of white noise
        at ``rate`` with the same power at low frequencies.
    """
    frequency, power = power_spectrum(channel, rate)
    lowest, highest = LOWEST * rate, rate / 2
    if measured_at is not None and measured_at < SLOWER * rate:
        lowest, highest = LOWEST * measured_at, HIGHEST * measured_at
        heard = int(np.searchsorted(frequency, highest))
        frequency, power = frequency[:heard], power[:heard]
    edges = np.searchsorted(frequency, np.linspace(lowest, highest, BANDS + 1))
    bands = np.array([power[a:b].mean(axis=0) for a, b in pairwise(edges) if b > a])
    if len(bands) < BANDS:
        return np.zeros(channel.shape[1])
    # Neighbouring bins of a Hann window are correlated: about half of them are independent.
    chance = LEAST_OF_BANDS / np.sqrt(max((edges[-1] - edges[0]) / BANDS / 1.94, 4.0))
    quietest = bands.min(axis=0) / (1 - chance)
    deviation: FloatArray = np.sqrt(np.minimum(quietest, _level_between_lines(power[edges[0] :])))
    return deviation


def _level_between_lines(power: FloatArray) -> FloatArray:
    """Return the mean (c,) of exponentially distributed powers (F, c), of which some are lines.

    Powers far above the mean of the others are left out, again and again (consecutive mean
    excision; Henttu and Aromaa 2002, ISSSTA).
    """
    level = np.quantile(power, QUIET, axis=0) / -np.log1p(-QUIET)
    # Mean of an exponential distribution up to EXCISION times its mean, over that mean.
    kept_mean = 1 - EXCISION / np.expm1(EXCISION)
    for _ in range(EXCISIONS):
        kept = power <= EXCISION * level
        level = np.sum(power * kept, axis=0) / np.maximum(kept.sum(axis=0), 1) / kept_mean
    return np.asarray(level)


def add_noise(segment: Segment, channels: Sequence[Channel]) -> Segment:
    """Return the segment with as much noise added to the given channels as they already have.

    The random numbers are reproducible.
    """
    # Seeds must not be negative, but stamps may be.
    rng = np.random.default_rng([0, int(segment.stamp[0]) % 2**64, len(segment)])
    noisy = {}
    for name in channels:
        signal = getattr(segment, name)
        flat = signal.reshape(len(signal), -1)
        deviation = np.zeros(flat.shape[1])
        rates = _rates(segment, name, flat.shape[1])
        for rate in np.unique(rates):
            some = rates == rate
            deviation[some] = noise_deviation(flat[:, some], segment.rate, float(rate))
        noise = rng.standard_normal(flat.shape) * deviation
        noisy[name] = signal + noise.reshape(signal.shape)
    return replace(segment, **noisy)


def _rates(segment: Segment, channel: Channel, columns: int) -> FloatArray:
    """Return the rate (c,), Hz, at which each column of a flat channel was measured."""
    imus = len(segment.imu_frames)
    places = {"wrenches": slice(imus, None), **dict.fromkeys(IMU_CHANNELS, slice(imus))}
    if channel not in places or not segment.sensor_rates:
        return np.full(columns, segment.rate)
    own = segment.sensor_rates[places[channel]]
    return np.repeat(own, columns // max(len(own), 1))
