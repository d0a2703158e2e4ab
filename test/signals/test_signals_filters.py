"""Smoothing filters: what they leave exact, and how alike they make neighbouring rows."""

import numpy as np
import pytest

from symbid_ros.errors import DataError
from symbid_ros.signals.filters import LowPass, SavitzkyGolay, row_inflation

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
    with pytest.raises(DataError, match=r"longer than a stretch of 0\.05 s; shorten it"):
        SavitzkyGolay(0.081).force(np.zeros((50, 2)), 1000.0)


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
