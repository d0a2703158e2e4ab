"""The real-time velocity: it looks at no future, and is a Butterworth by its response."""

import numpy as np
import pytest

from symbid_ros.errors import DataError
from symbid_ros.signals.filters import CausalLowPass

RATE = 1000.0
TIME = np.arange(4000) / RATE


def response(low_pass: CausalLowPass, frequency: float) -> complex:
    """Return the steady-state gain and phase of a sine, by projection over whole periods."""
    wave = np.exp(2j * np.pi * frequency * TIME)
    answer = low_pass(wave.imag[:, None], RATE)[2000:, 0]
    return 2j * np.mean(answer * wave[2000:].conj())


@pytest.mark.parametrize("cutoff", [20.0, 50.0, 120.0])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0, 2.0])
def test_gain_and_phase_are_a_second_order_butterworths(cutoff, share):
    frequency = share * cutoff
    # The bilinear transform bends the axis of frequencies; s is in units of the cutoff.
    s = 1j * np.tan(np.pi * frequency / RATE) / np.tan(np.pi * cutoff / RATE)
    expected = 1 / (s**2 + np.sqrt(2) * s + 1)
    assert response(CausalLowPass(cutoff), frequency) == pytest.approx(expected, abs=1e-4)


def test_slow_signals_come_late_by_the_documented_time():
    late = -np.angle(response(CausalLowPass(50.0), 2.0)) / (2 * np.pi * 2.0)
    assert late == pytest.approx(0.225 / 50, rel=0.01)


def test_the_future_is_not_looked_at():
    rng = np.random.default_rng(0)
    position = rng.normal(size=(300, 4))
    other = position.copy()
    other[200:] += 1
    low_pass = CausalLowPass()
    before, after = low_pass.velocity(position, RATE), low_pass.velocity(other, RATE)
    np.testing.assert_array_equal(before[:200], after[:200])
    assert np.all(before[200] != after[200])


@pytest.mark.parametrize("cutoff", [0.0, 10.0, 50.0])
def test_steady_speed_is_found_once_the_start_is_forgotten(cutoff):
    low_pass = CausalLowPass(cutoff)
    speed = np.array([[2.0, -0.3], [0.1, 5.0]])
    found = low_pass.velocity(TIME[:, None, None] * speed, RATE)[low_pass.settling(RATE) :]
    np.testing.assert_allclose(found, np.broadcast_to(speed, found.shape), rtol=2e-4)


def test_a_resting_signal_is_left_alone():
    signal = np.full((100, 3), 7.0)
    np.testing.assert_allclose(CausalLowPass()(signal, RATE), signal, rtol=1e-12)


@pytest.mark.parametrize("cutoff", [-1.0, np.nan, np.inf, 500.0])
def test_what_is_no_cutoff_is_refused(cutoff):
    with pytest.raises(DataError, match="cutoff"):
        CausalLowPass(cutoff)(np.zeros((10, 1)), RATE)
