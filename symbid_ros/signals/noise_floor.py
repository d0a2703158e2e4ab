"""Estimates the white-noise level of each channel from its spectrum."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.segments import Segment

Channel = Literal["position", "angular_velocity", "effort", "wrenches"]
# Channels that are differentiated, whose noise enters the regressor. The accelerometer is excluded:
# its averaged noise is small compared with gravity, and vibration of the base fills all its bands.
MOTION: tuple[Channel, ...] = ("position", "angular_velocity")
# Channels whose noise also enters the columns of sensor gains.
FORCES: tuple[Channel, ...] = ("effort", "wrenches")

# The quietest of these equal bands, from this share of the rate up to half of it, is assumed to
# hold only noise. Vibration rarely fills all of them.
BANDS = 8
LOWEST = 0.1
# Magnitude of the expected minimum of eight standard normal variables, for the quietest band.
LEAST_OF_BANDS = 1.4236


def noise_deviation(channel: FloatArray, rate: float) -> FloatArray:
    """Return the standard deviation (c,) of the white noise in signals (N, c).

    The spectrum of white noise is flat, so its level in one quiet band holds for all bands.
    """
    count = len(channel)
    window = np.hanning(count + 2)[1:-1, None]
    spectrum = np.fft.rfft((channel - channel.mean(axis=0)) * window, axis=0)
    power = np.abs(spectrum) ** 2 / np.sum(window**2)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    edges = np.searchsorted(frequency, np.linspace(LOWEST * rate, rate / 2, BANDS + 1))
    bands = np.array([power[a:b].mean(axis=0) for a, b in pairwise(edges) if b > a])
    if len(bands) < BANDS:
        return np.zeros(channel.shape[1])
    # Neighbouring bins of a Hann window are correlated: about half of them are independent.
    chance = LEAST_OF_BANDS / np.sqrt(max((edges[-1] - edges[0]) / BANDS / 1.94, 4.0))
    deviation: FloatArray = np.sqrt(bands.min(axis=0) / (1 - chance))
    return deviation


def with_more_noise(segment: Segment, channels: Sequence[Channel]) -> Segment:
    """Return the segment with as much noise added to the given channels as they already have.

    The random numbers are reproducible.
    """
    # Seeds must not be negative, but stamps may be.
    rng = np.random.default_rng([0, int(segment.stamp[0]) % 2**64, len(segment)])
    noisy = {}
    for name in channels:
        signal = getattr(segment, name)
        flat = signal.reshape(len(signal), -1)
        noise = rng.standard_normal(flat.shape) * noise_deviation(flat, segment.rate)
        noisy[name] = signal + noise.reshape(signal.shape)
    return replace(segment, **noisy)
