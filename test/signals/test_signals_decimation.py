"""Decimation of sines, whose filtered values and derivatives are known in closed form."""

import numpy as np
import pytest

from symbid_ros.signals.decimation import Decimator, decimation_stride, low_passed
from symbid_ros.signals.filters import LowPass

RATE, CUTOFF, EDGE = 1000.0, 100.0, 40


def decimator(stride=4, rate=RATE, cutoff=CUTOFF):
    return Decimator(rate, stride, LowPass(cutoff, passes=1), 2 / 0.081, EDGE)


def gain(frequency):
    """Response of the second-order Butterworth low-pass forwards and backwards."""
    ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * CUTOFF / RATE)
    return 1 / (1 + ratio**4)


def slope(frequency):
    """Response of the central difference, rad/s."""
    return RATE * np.sin(2 * np.pi * frequency / RATE)


@pytest.mark.parametrize("frequency", [0.5, 7.0, 31.0, 70.0])
@pytest.mark.parametrize("stride", [1, 4])
def test_a_sine_in_the_passband_keeps_its_derivatives(frequency, stride):
    angle = 2 * np.pi * frequency * np.arange(700) / RATE + 0.3
    found = decimator(stride).motion(np.sin(angle)[:, None], 2)
    at = angle[EDGE : len(angle) - EDGE : stride]
    size = gain(frequency)
    rate = slope(frequency)
    expected = size * np.sin(at), size * rate * np.cos(at), -size * rate**2 * np.sin(at)
    for one, other in zip(found, expected, strict=True):
        error = np.abs(one[:, 0] - other)
        # Near the ends the kernel reaches a little beyond the signal.
        assert error.max() < 2e-2 * np.abs(other).max()
        assert error[20:-20].max() < 1e-3 * np.abs(other).max()


@pytest.mark.parametrize("frequency", [226.0, 250.0, 262.0, 480.0])
def test_frequencies_that_would_alias_are_removed(frequency):
    angle = 2 * np.pi * frequency * np.arange(1200) / RATE
    found = decimator().motion(np.sin(angle)[:, None], 2)
    for order, one in enumerate(found):
        left = np.abs(one[30:-30]).max() / slope(frequency) ** order
        assert left < 3e-4 * gain(frequency) + 1e-7


def test_a_constant_and_a_ramp_are_exact_up_to_the_ends():
    time = np.arange(500) / RATE
    signal = np.stack([np.full(500, 3.0), 2.0 * time], axis=1)
    value, rate, acceleration = decimator().motion(signal, 2)
    np.testing.assert_allclose(value, signal[EDGE:-EDGE:4], rtol=1e-10)
    np.testing.assert_allclose(rate, np.tile([0.0, 2.0], (len(rate), 1)), atol=1e-8)
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-5)


def test_all_instants_are_filtered_with_the_same_kernel():
    signal = np.random.default_rng(0).standard_normal((300, 2, 3))
    every = decimator().every(signal, 1)
    some = decimator().motion(signal, 1)
    for one, other in zip(every, some, strict=True):
        assert one.shape == signal.shape
        np.testing.assert_allclose(one[EDGE:-EDGE:4], other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("rate", "cutoff", "stride"),
    [(4000, 100, 16), (1000, 100, 4), (500, 50, 3), (250, 25, 1), (100, 20, 1), (20, 5, 1)],
)
def test_enough_rows_are_left_for_the_low_pass_and_the_windows(rate, cutoff, stride):
    assert decimation_stride(rate, cutoff, 0.081) == stride


@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize("count", [900, 1201])
def test_the_low_pass_by_fft_equals_the_recursive_one(passes, count):
    signal = np.cumsum(np.random.default_rng(1).standard_normal((count, 2)), axis=0)
    low_pass = LowPass(30.0, passes=passes)
    expected = low_pass(signal, RATE, passes)
    found = low_passed(signal, low_pass, RATE)
    settled = slice(220, -220)  # SciPy pads the ends by less
    np.testing.assert_allclose(found[settled], expected[settled], atol=1e-5 * np.ptp(signal))
