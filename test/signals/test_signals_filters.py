"""Smoothing filters: the signals they preserve, and the correlation of neighbouring rows."""

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

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
    """The filter commutes with products by constants, so K φ = y holds after it."""
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
def test_invalid_windows_and_degrees_are_rejected(window, degree):
    with pytest.raises(DataError, match="positive window and a degree of at least 2"):
        SavitzkyGolay(window, degree)


def test_a_window_longer_than_the_record_is_rejected():
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
def test_row_inflation_follows_from_the_covariance(smoothing, rate):
    # Impulses at every sample: rows @ rows.T is the covariance of filtered white noise.
    count = 2 * smoothing.settling(rate) + 12 * int(rate / 10)
    response = smoothing.force(np.eye(count), rate)[:: smoothing.stride(rate)]
    covariance = response @ response.T
    middle = len(covariance) // 2
    # Variance of the mean of many rows, relative to that of independent rows.
    expected = covariance[middle].sum() / covariance[middle, middle]
    assert row_inflation(smoothing, rate) == pytest.approx(max(expected, 1.0), rel=1e-3)


@pytest.mark.parametrize("smoothing", SMOOTHINGS[1:], ids=str)
def test_edge_effects_vanish_after_settling(smoothing):
    """Rows in the middle of a record equal those of a longer record."""
    rng = np.random.default_rng(7)
    signal = np.cumsum(rng.standard_normal((3000, 2)), axis=0)
    edge = smoothing.settling(1000.0)
    whole = smoothing.motion(signal, 1000.0, 2)
    part = smoothing.motion(signal[1000:2000], 1000.0, 2)
    for long, short in zip(whole, part, strict=True):
        error = np.abs(short - long[1000:2000])[edge:-edge]
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.std(long)


@pytest.mark.parametrize("smoothing", [SavitzkyGolay(), LowPass(20.0)])
def test_nan_channels_stay_nan_and_affect_no_other_channel(smoothing) -> None:
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
    # The bilinear transform warps the frequencies; s is in units of the cutoff.
    s = 1j * np.tan(np.pi * frequency / RATE) / np.tan(np.pi * cutoff / RATE)
    expected = 1 / (s**2 + np.sqrt(2) * s + 1)
    assert response(CausalLowPass(cutoff), frequency) == pytest.approx(expected, abs=1e-4)


def test_slow_signals_are_delayed_by_the_documented_time():
    late = -np.angle(response(CausalLowPass(50.0), 2.0)) / (2 * np.pi * 2.0)
    assert late == pytest.approx(0.225 / 50, rel=0.01)


def test_the_filter_is_causal():
    rng = np.random.default_rng(0)
    position = rng.normal(size=(300, 4))
    other = position.copy()
    other[200:] += 1
    low_pass = CausalLowPass()
    before, after = low_pass.velocity(position, RATE), low_pass.velocity(other, RATE)
    np.testing.assert_array_equal(before[:200], after[:200])
    assert np.all(before[200] != after[200])


@pytest.mark.parametrize("cutoff", [0.0, 10.0, 50.0])
def test_steady_speed_is_recovered_after_settling(cutoff):
    low_pass = CausalLowPass(cutoff)
    speed = np.array([[2.0, -0.3], [0.1, 5.0]])
    found = low_pass.velocity(TIME[:, None, None] * speed, RATE)[low_pass.settling(RATE) :]
    np.testing.assert_allclose(found, np.broadcast_to(speed, found.shape), rtol=2e-4)


def test_a_constant_signal_does_not_change():
    signal = np.full((100, 3), 7.0)
    np.testing.assert_allclose(CausalLowPass()(signal, RATE), signal, rtol=1e-12)


@pytest.mark.parametrize("cutoff", [-1.0, np.nan, np.inf, 500.0])
def test_invalid_cutoffs_are_rejected(cutoff):
    with pytest.raises(DataError, match="cutoff"):
        CausalLowPass(cutoff)(np.zeros((10, 1)), RATE)


@pytest.mark.parametrize(
    ("smoothing", "rate", "settling", "stride"),
    [
        (LowPass(0), 1000.0, 2, 1),
        (LowPass(30.0), 1000.0, 100, 6),
        (LowPass(30.0), 1001.0, 101, 6),
        (LowPass(30.0, passes=1), 1000.0, 34, 6),
        (LowPass(30.0, "thesis", passes=1), 1000.0, 100, 6),
        (LowPass(400.0, passes=1), 1000.0, 3, 1),
        (LowPass(40.0), 400.0, 30, 2),
        (LowPass(41.0), 400.0, 30, 1),
        (LowPass(450.0, passes=1), 901.0, 3, 1),
        (SavitzkyGolay(0.08), 1000.0, 40, 20),
        (SavitzkyGolay(0.08), 100.0, 4, 2),
        (SavitzkyGolay(0.01, 2), 100.0, 2, 1),
        (SavitzkyGolay(0.01, 3), 100.0, 2, 1),
        (SavitzkyGolay(0.01, 4), 100.0, 3, 1),
        (SavitzkyGolay(0.07, 3), 100.0, 4, 2),
    ],
)
def test_edges_and_strides_follow_the_cutoff_or_the_window(smoothing, rate, settling, stride):
    assert (smoothing.settling(rate), smoothing.stride(rate)) == (settling, stride)


@pytest.mark.parametrize(
    ("smoothing", "says"),
    [
        (LowPass(0), "none"),
        (LowPass(20.0), "second-order Butterworth at 20 Hz, zero phase, 3 passes"),
        (LowPass(20.0, "thesis"), "second-order Butterworth at 20 Hz, zero phase, the thesis's"),
        (SavitzkyGolay(0.05, 4), "Savitzky-Golay, 50 ms, degree 4"),
    ],
)
def test_filters_describe_themselves(smoothing, says):
    assert str(smoothing).startswith(says)


@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize("count", [60, 400])
def test_passes_forwards_and_backwards_are_scipys(passes, count):
    """The ends are extended by three periods of the cutoff per pass, or by the whole signal."""
    signal = np.random.default_rng(1).normal(size=(count, 2))
    low_pass = LowPass(25.0, passes=passes)
    b, a = butter(2, 25.0, fs=500.0)
    b, a = (np.atleast_1d(np.poly1d(each) ** passes) for each in (b, a))
    padding = min(count - 1, 60 * passes)
    expected = filtfilt(b, a, signal, axis=0, padlen=padding)
    np.testing.assert_allclose(low_pass.force(signal, 500.0), expected, atol=1e-6)


@pytest.mark.parametrize("channels", ["all", "thesis"])
def test_derivatives_are_central_differences_between_passes(channels):
    signal = np.random.default_rng(2).normal(size=(300, 2))
    low_pass = LowPass(30.0, channels, passes=2)
    found = low_pass.motion(signal, 500.0, 2)
    expected = [low_pass(signal, 500.0, 2 if channels == "all" else 1)]
    for _ in range(2):
        slope = np.empty_like(signal)
        last = expected[-1]
        slope[1:-1] = (last[2:] - last[:-2]) * 250.0
        slope[0] = (-1.5 * last[0] + 2 * last[1] - 0.5 * last[2]) * 500.0
        slope[-1] = (1.5 * last[-1] - 2 * last[-2] + 0.5 * last[-3]) * 500.0
        expected.append(low_pass(slope, 500.0) if channels == "thesis" else slope)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_a_cutoff_is_below_half_the_rate():
    signal = np.zeros((50, 1))
    LowPass(49.9).force(signal, 100.0)
    with pytest.raises(DataError, match="50 Hz is not below half the rate of 100 Hz"):
        LowPass(50.0).force(signal, 100.0)


@pytest.mark.parametrize(("cutoff", "settling"), [(0, 1), (50.0, 41), (30.0, 68)])
def test_a_causal_filter_settles_within_two_periods(cutoff, settling):
    low_pass = CausalLowPass(cutoff)
    assert low_pass.settling(1000.0) == settling
    if cutoff:
        step = low_pass(np.r_[0.0, np.ones(999)][:, None], 1000.0)
        assert np.abs(step[settling:] - 1).max() < 1e-3
