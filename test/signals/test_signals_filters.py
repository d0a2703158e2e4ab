"""Smoothing filters: what they leave exact, and how alike they make neighbouring rows."""

import numpy as np
import pytest

from symbid_ros.errors import DataError
from symbid_ros.signals.filters import CausalLowPass, LowPass, SavitzkyGolay, row_inflation

RATES = [200.0, 1000.0]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_savitzky_golay_differentiates_polynomials_of_its_degree_exactly(degree, rate):
    time = np.arange(300) / rate
    smoothing = SavitzkyGolay(0.081, degree)
    rng = np.random.default_rng(degree)
    polynomials = [np.polynomial.Polynomial(rng.normal(size=degree + 1)) for _ in range(3)]
    signal = np.stack([polynomial(time) for polynomial in polynomials], axis=1)
    for order, found in enumerate(smoothing.motion(signal, rate, 2)):
        exact = np.stack([p.deriv(order)(time) if order else p(time) for p in polynomials], axis=1)
        np.testing.assert_allclose(found, exact, atol=1e-8 * max(1, rate**order * 1e-4))
    np.testing.assert_array_equal(
        smoothing.force(signal, rate), smoothing.motion(signal, rate, 0)[0]
    )


def test_savitzky_golay_treats_every_channel_and_both_sides_alike():
    """Averages of a product with constants commute with the filter: K φ stays y."""
    rng = np.random.default_rng(0)
    acceleration = rng.standard_normal((400, 3))
    smoothing = SavitzkyGolay()
    inertia = np.array([2.0, 0.3, 5.0])
    np.testing.assert_allclose(
        smoothing.force(acceleration @ inertia, 1000.0),
        smoothing.force(acceleration, 1000.0) @ inertia,
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("window", "degree"), [(0.0, 3), (-0.1, 3), (np.nan, 3), (np.inf, 3), (0.08, 1), (0.08, -2)]
)
def test_what_is_no_window_or_degree_is_refused(window, degree):
    with pytest.raises(DataError, match="positive window and a degree of at least 2"):
        SavitzkyGolay(window, degree)


def test_a_window_longer_than_the_record_is_refused():
    with pytest.raises(DataError, match=r"longer than a segment of 0\.05 s; shorten"):
        SavitzkyGolay(0.081).force(np.zeros((50, 2)), 1000.0)


def test_savitzky_golay_drops_half_a_window_at_each_end():
    assert SavitzkyGolay(0.081).settling(1000.0) == 40


@pytest.mark.parametrize("rate", RATES)
def test_a_window_of_fewer_samples_than_its_degree_needs_is_widened(rate):
    smoothing = SavitzkyGolay(1e-4, 4)
    signal = (np.arange(50) / rate)[:, None] ** 4
    np.testing.assert_allclose(smoothing.force(signal, rate), signal, atol=1e-12)


SMOOTHINGS = [
    LowPass(0),
    LowPass(30.0),
    LowPass(12.5, passes=1),
    LowPass(30.0, "thesis"),
    SavitzkyGolay(),
    SavitzkyGolay(0.16, 5),
]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("smoothing", SMOOTHINGS, ids=str)
def test_rows_look_more_than_they_are_by_their_covariance(smoothing, rate):
    # Impulses at every sample: rows @ rows.T is the covariance of white noise let through.
    count = 2 * smoothing.settling(rate) + 12 * int(rate / 10)
    response = smoothing.force(np.eye(count), rate)[:: smoothing.stride(rate)]
    covariance = response @ response.T
    middle = len(covariance) // 2
    # Variance of the mean of many rows, over what independent rows would have.
    expected = covariance[middle].sum() / covariance[middle, middle]
    assert row_inflation(smoothing, rate) == pytest.approx(max(expected, 1.0), rel=1e-3)


@pytest.mark.parametrize("smoothing", SMOOTHINGS[1:], ids=str)
def test_nothing_is_left_of_the_edge_once_settled(smoothing):
    """A record's ends are forgotten: rows of its middle are those of a longer record."""
    rng = np.random.default_rng(7)
    signal = np.cumsum(rng.standard_normal((3000, 2)), axis=0)
    edge = smoothing.settling(1000.0)
    whole = smoothing.motion(signal, 1000.0, 2)
    part = smoothing.motion(signal[1000:2000], 1000.0, 2)
    for long, short in zip(whole, part, strict=True):
        error = np.abs(short - long[1000:2000])[edge:-edge]
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.std(long)


@pytest.mark.parametrize("smoothing", [SavitzkyGolay(), LowPass(20.0)])
def test_what_was_not_measured_stays_so_and_spoils_no_other_channel(smoothing) -> None:
    signal = np.random.default_rng(5).normal(size=(300, 4))
    whole = smoothing.force(signal, 1000.0)
    signal[:, 2] = np.nan
    found = smoothing.force(signal, 1000.0)
    assert np.isnan(found[:, 2]).all()
    others = [0, 1, 3]
    np.testing.assert_allclose(found[:, others], whole[:, others], rtol=1e-9, atol=1e-12)


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
