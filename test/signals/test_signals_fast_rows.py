"""Rows in bands of frequencies, on robots whose motion is a sum of known sines."""

from dataclasses import replace

import analytic_log
import numpy as np
import pytest
from analytic_log import analytic_segment
from random_robots import random_robot

from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.fast_rows import (
    CUTOFF,
    LENGTH,
    SETTLING,
    Bands,
    FastRows,
    noise_below_motion,
)

BANDS = Bands(1000.0)


def shaken_segment(parameters, seed, seconds=1.5):
    return analytic_segment(parameters, seconds, seed, shaking=5.0)


@pytest.fixture(scope="module", params=[1, 2, 3])
def robot(request):
    return ParameterSet(random_robot(request.param, 4))


def test_bands_lie_between_the_windows_and_a_share_of_the_rate():
    assert len(Bands(150.0)) == 0
    assert len(Bands(250.0)) == 1
    assert np.allclose(BANDS.frequencies, [24.7, 49.4, 74.1, 98.8, 123.5], atol=0.1)


def test_rows_hold_for_the_true_robot(robot):
    rows = FastRows.of(shaken_segment(robot, 4), robot, BANDS)
    residuals = rows.residuals(robot.values)
    size = np.sqrt(np.mean(np.abs(rows.y) ** 2, axis=0))
    error = np.sqrt(np.mean(np.abs(residuals) ** 2, axis=0))
    assert np.all(error < 0.01 * size.max(axis=1, keepdims=True))


def test_no_rows_of_a_block_shorter_than_a_window_and_its_filter(robot):
    assert FastRows.of(shaken_segment(robot, 4, seconds=0.2), robot, BANDS) is None


@pytest.mark.parametrize("band", [0, 3])
def test_residuals_answer_to_a_wave_in_a_channel_as_the_responses_say(robot, band, monkeypatch):
    # Responses leave out what noise does through postures and rates, which matters in fast motion.
    monkeypatch.setattr(analytic_log, "SLOWEST", 0.1)
    monkeypatch.setattr(analytic_log, "FASTEST", 0.2)
    segment = shaken_segment(robot, 5)
    before = FastRows.of(segment, robot, BANDS)
    slope = before.responses().of_residual(robot.values)
    frequency = BANDS.frequencies[band]
    since = (segment.stamp - segment.stamp[0]) * 1e-9
    wave = 1e-3 * np.cos(2 * np.pi * frequency * since)
    # The phase at the middle of each window; half the wave turns the other way and is averaged out.
    first = 1e-3 * int(SETTLING / CUTOFF)
    middle = first + LENGTH / 2 * np.arange(1, len(before) + 1)
    average = 0.5e-3 * np.exp(2j * np.pi * frequency * middle)
    place = 0
    derivative = (2j * np.pi * frequency) ** before.channels.order
    fields = ("position", "angular_velocity", "linear_acceleration", "effort", "wrenches")
    for name in fields:
        values = getattr(segment, name)
        flat = values.reshape(len(values), -1)
        for column in range(flat.shape[1]):
            if column % 4:  # a few of each kind
                place += 1
                continue
            scale = 1e-2 if name == "position" else 1.0
            more = flat.copy()
            more[:, column] += scale * wave
            spoilt = replace(segment, **{name: more.reshape(values.shape)})
            change = FastRows.of(spoilt, robot, BANDS).residuals(robot.values)
            change = (change - before.residuals(robot.values))[:, band]
            expected = slope[:, :, place] * (scale * average * derivative[place])[:, None]
            size = np.abs(expected).max()
            assert np.abs(change - expected).max() < 0.05 * size + 1e-9, (name, column)
            place += 1
    assert place == len(before.channels)


@pytest.mark.parametrize("band", range(len(BANDS)))
@pytest.mark.parametrize("order", [0, 1, 2])
def test_noise_of_derivatives_is_as_large_as_the_band_says(band, order):
    power, factors = BANDS.noise
    rng = np.random.default_rng(band)
    count = round(LENGTH * 1000)
    time = (np.arange(4001) - 2000) * 1e-3
    window = np.where(np.abs(time) < LENGTH / 2, np.cos(np.pi * time / LENGTH) ** 2, 0.0)
    test = window / window.sum() * np.exp(-2j * np.pi * BANDS.frequencies[band] * time)
    noise = 1e3**order * np.diff(rng.standard_normal((400, len(time) + order)), order, axis=1)
    shifts = range(-1500, 1500, count)
    averages = np.concatenate([noise @ np.roll(test, shift) for shift in shifts])
    expected = power * factors[band, order] ** 2
    assert np.mean(np.abs(averages) ** 2) == pytest.approx(expected, rel=0.05)


def test_noise_is_told_apart_from_motion_at_all_frequencies():
    rng = np.random.default_rng(1)
    white = rng.standard_normal((40_000, 3))
    frequency = np.fft.rfftfreq(len(white), 1e-3)[1:, None]
    spectrum = np.fft.rfft(rng.standard_normal(white.shape), axis=0)
    spectrum[0] = 0
    spectrum[1:] *= (300 / frequency) ** np.array([0.0, 1.0, 2.0])
    motion = np.fft.irfft(spectrum, len(white), axis=0) * np.array([0.0, 1.0, 1.0])
    found = noise_below_motion(white + motion, 1000.0)
    assert np.allclose(found, 1.0, rtol=0.15)
    assert noise_below_motion(np.zeros((4000, 1)), 1000.0) == 0
