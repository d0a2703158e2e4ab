"""How noisy each channel is, from the channel alone."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.segments import Segment

Channel = Literal["position", "angular_velocity", "effort", "wrenches"]
# What is differentiated, and thereby brings noise into the regressor. The accelerometer is left
# alone: its averaged noise is nothing beside gravity, while a vibrating base shakes it in every
# band.
MOTION: tuple[Channel, ...] = ("position", "angular_velocity")
# What brings noise into the columns of sensors' gains as well.
FORCES: tuple[Channel, ...] = ("effort", "wrenches")

# The quietest of these equal bands, from this share of the rate up to half of it, is taken to hold
# noise alone: a vibrating robot fills some of them, hardly ever all.
BANDS = 8
LOWEST = 0.1
# Expected least of eight standard normal numbers: what the quietest band is by chance.
LEAST_OF_BANDS = 1.4236


def noise_deviation(channel: FloatArray, rate: float) -> FloatArray:
    """Return the standard deviation (c,) of the white noise in signals (N, c).

    The spectrum of white noise is flat, so its level in one quiet band is its level
    everywhere, also where motion hides it.
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
    # Neighbouring bins of a Hann window share their noise: about half of them are independent.
    chance = LEAST_OF_BANDS / np.sqrt(max((edges[-1] - edges[0]) / BANDS / 1.94, 4.0))
    deviation: FloatArray = np.sqrt(bands.min(axis=0) / (1 - chance))
    return deviation


def with_more_noise(segment: Segment, channels: Sequence[Channel]) -> Segment:
    """Return the stretch with as much noise again on the channels that are named.

    The draw is the same every time.
    """
    # A seed is not negative; a stamp may be.
    rng = np.random.default_rng([0, int(segment.stamp[0]) % 2**64, len(segment)])
    noisy = {}
    for name in channels:
        signal = getattr(segment, name)
        flat = signal.reshape(len(signal), -1)
        noise = rng.standard_normal(flat.shape) * noise_deviation(flat, segment.rate)
        noisy[name] = signal + noise.reshape(signal.shape)
    return replace(segment, **noisy)
