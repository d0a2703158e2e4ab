"""The level of white noise in the presence of motion and vibration."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_segment, noisy
from random_robots import random_robot

from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_noise import FORCES, MOTION, add_noise, noise_deviation
from symbid_ros.signals.splines import interpolating_spline

RATE = 1000.0
TIME = np.arange(4000) / RATE


def slow_motion(rng, size, channels=6):
    frequency, phase = rng.uniform(0.2, 8, (3, channels)), rng.uniform(0, 6, (3, channels))
    wave = np.sin(2 * np.pi * np.multiply.outer(TIME, frequency) + phase)
    return 5.0 + size * wave.sum(axis=1)


@pytest.mark.parametrize("size", [0.0, 1.0, 1e4])
def test_white_noise_is_found_under_motion_of_any_size(size):
    rng = np.random.default_rng(1)
    truth = np.array([1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0])
    found = noise_deviation(slow_motion(rng, size) + truth * rng.standard_normal((4000, 6)), RATE)
    # 200 bins in each of eight bands, the quietest of them.
    np.testing.assert_allclose(found, truth, rtol=0.08)


def test_the_noise_level_is_unbiased_for_blocks_of_any_rate():
    rng = np.random.default_rng(2)
    for count in (800, 2000, 4000):
        found = noise_deviation(rng.standard_normal((count, 200)), RATE)
        assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.05)


def test_vibration_in_some_bands_is_not_counted_as_noise():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((4000, 4))
    spectrum = np.fft.rfft(rng.standard_normal((4000, 4)), axis=0)
    frequency = np.fft.rfftfreq(4000, 1 / RATE)
    spectrum[(frequency < 250) | (frequency > 390)] = 0
    lines = np.sin(2 * np.pi * TIME * 131.0) + np.sin(2 * np.pi * TIME * 222.2)
    shaken = noise + 50 * np.fft.irfft(spectrum, axis=0) + 100 * lines[:, None]
    np.testing.assert_allclose(noise_deviation(shaken, RATE), 1.0, rtol=0.1)


@pytest.mark.parametrize("steps", [2.1, 3.05])
def test_harmonics_of_a_gait_are_not_counted_as_noise(steps):
    """A trot with impacts fills every band with lines, at any rate."""
    rate, count = 100.0, 400
    rng, time = np.random.default_rng(5), np.arange(count) / rate
    orders = np.arange(1, int(rate / 2 / steps))
    gait = np.sum(np.sin(2 * np.pi * np.outer(time, steps * orders) + orders) / orders, axis=1)
    found = noise_deviation(10 * gait[:, None] + rng.standard_normal((count, 200)), rate)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_an_exact_channel_has_no_noise(size):
    channel = slow_motion(np.random.default_rng(4), size)
    assert np.all(noise_deviation(channel, RATE) < 1e-8)


@pytest.mark.parametrize("slower", [2, 3, 10])
def test_noise_of_slower_sensors_is_that_at_low_frequencies(slower):
    """Interpolated noise has no power above half of the sensor's rate, and more below."""
    rng = np.random.default_rng(7)
    coarse = rng.standard_normal((len(TIME) // slower + 2, 200))
    dense = interpolating_spline(slower / RATE * np.arange(len(coarse)), coarse)(TIME)
    found = noise_deviation(slow_motion(rng, 0.01, 200) + dense, RATE, RATE / slower)
    assert np.sqrt(np.mean(found**2) / slower) == pytest.approx(1.0, abs=0.07)
    assert noise_deviation(dense, RATE).max() < 0.1


def test_a_short_record_gives_zero_noise():
    noise = np.random.default_rng(6).standard_normal((12, 3))
    np.testing.assert_array_equal(noise_deviation(noise, RATE), 0)


def test_noise_is_added_to_named_channels_and_is_reproducible():
    parameters = ParameterSet(random_robot(1, links=4))
    exact = analytic_segment(parameters, 3.0, 1)
    levels = {"position": 1e-4, "rate": 0.02, "acceleration": 0.1, "effort": 0.5, "wrench": 2.0}
    segment = noisy(exact, np.random.default_rng(5), **levels)
    more, again = add_noise(segment, MOTION), add_noise(segment, MOTION)
    for field in MOTION:
        np.testing.assert_array_equal(getattr(more, field), getattr(again, field))
    for field in FORCES:
        np.testing.assert_array_equal(getattr(more, field), getattr(segment, field))
    for field, level in zip(MOTION, (1e-4, 0.02, 0.1), strict=True):
        added = getattr(more, field) - getattr(segment, field)
        np.testing.assert_allclose(added.std(axis=0), level, rtol=0.1)
        # As independent of the noise that is there as noise of another day.
        there = getattr(segment, field) - getattr(exact, field)
        correlation = np.mean(added * there, axis=0) / level**2
        assert np.all(np.abs(correlation) < 5 / np.sqrt(len(segment)))
    added = add_noise(segment, FORCES).wrenches - segment.wrenches
    np.testing.assert_allclose(added.std(axis=0)[:, 3:], 2.0, rtol=0.1)


def test_noise_is_added_to_slower_sensors_as_they_have_it():
    parameters, rng = ParameterSet(random_robot(1, links=4)), np.random.default_rng(8)
    exact = analytic_segment(parameters, 12.0, 1)
    time, slower = np.arange(len(exact)), 3
    coarse = 2.0 * rng.standard_normal((len(exact) // slower + 2, 6))
    heard = interpolating_spline(slower * np.arange(len(coarse)), coarse)(time)
    wrenches = exact.wrenches.copy()
    wrenches[:, -1] += heard
    rates = [exact.rate] * len(exact.frames)
    rates[-1] /= slower
    segment = replace(exact, wrenches=wrenches, sensor_rates=tuple(rates))
    added = add_noise(segment, FORCES).wrenches - wrenches
    np.testing.assert_allclose(added[:, -1].std(axis=0), 2.0 * np.sqrt(slower), rtol=0.15)
    assert np.abs(added[:, :-1]).max() < 1e-6
