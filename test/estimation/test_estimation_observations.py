"""Observations: residual covariance, merging, and whiteness of residuals."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from gaussian_logs import gaussian_log, noise_root, prior_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import CHANCE, definite, whiteness
from symbid_ros.estimation.posterior import posterior


def masked(log, seed, columns=2):
    valid = log.valid.copy()
    valid[:, -columns:] = np.random.default_rng(seed).random((len(log), columns)) < 0.5
    return replace(log, valid=valid)


def test_counts_are_the_numbers_of_common_samples():
    log = masked(gaussian_log(0), 0)
    n = log.K.shape[1]
    expected = [[np.sum(log.valid[:, i] & log.valid[:, j]) for j in range(n)] for i in range(n)]
    np.testing.assert_array_equal(log.observations().counts, expected)


def test_the_noise_covariance_is_found_despite_masked_rows():
    log = gaussian_log(1, count=4000)
    rng = np.random.default_rng(1)
    deviation = rng.uniform(0.1, 5.0, log.K.shape[1])
    for one in (log, masked(log, 1)):
        drawn = one.measured(rng, np.diag(deviation))
        found = drawn.observations().residual_covariance(log.truth, log.truth)
        np.testing.assert_allclose(np.sqrt(np.diag(found)), deviation, rtol=0.06)
        correlation = found / np.outer(deviation, deviation) - np.eye(len(found))
        assert np.abs(correlation).max() < 0.13


def test_vanishing_inertias_do_not_explain_rows_without_a_force():
    """The row of a joint without a drive fits them exactly; its load is known to 1 % at best."""
    log = gaussian_log(3, count=400)
    free = replace(log, y=log.y * np.append(np.ones(log.K.shape[1] - 1), 0.0)).observations()
    load = np.mean((log.K[:, -1] @ log.truth) ** 2)
    found = [free.residual_covariance(share * log.truth, log.truth)[-1, -1] for share in (1, 0)]
    assert found[0] == pytest.approx(load, rel=0.1)
    assert 1e-4 * load < found[1] < 3e-4 * load


def test_partly_masked_coordinates_are_independent():
    log = masked(gaussian_log(2, count=200), 2)
    found = log.observations().residual_covariance(log.truth, log.truth)
    alone = np.ones(found.shape, dtype=bool)
    alone[:-2, :-2] = False
    alone[np.diag_indices(len(found))] = False
    assert np.all(found[alone] == 0)
    assert np.all(found[:-2, :-2] != 0)


def test_orthonormal_combinations_have_one_variance():
    """Any other axes of their space give the same weights and thus the same estimate."""
    log = gaussian_log(7, count=400)
    one = log.observations()
    n = len(one.layout.coordinates)
    some = (0, 2)
    layout = replace(one.layout, combined=some)
    found = replace(one, rows=replace(one.rows, layout=layout), groups=None)
    phi = np.zeros(len(layout.parameters))
    covariance = found.residual_covariance(phi, phi)
    mean = found.rows.residual_moment(phi).diagonal() / found.counts.diagonal()
    others = np.setdiff1d(np.arange(n), some)
    alike = covariance.diagonal()[list(some)] / mean[list(some)].mean()
    np.testing.assert_allclose(alike, (covariance.diagonal() / mean)[others][0], rtol=1e-9)
    assert not covariance[np.ix_(some, others)].any()
    assert found.variance_ratio(phi)[list(some)].sum() == pytest.approx(len(some))
    np.testing.assert_array_equal(found.variance_ratio(phi)[others], 1.0)


def test_a_short_log_has_no_correlations():
    log = gaussian_log(3, count=8)
    found = log.observations().residual_covariance(log.truth, log.truth)
    np.testing.assert_array_equal(found, np.diag(np.diag(found)))


@pytest.mark.parametrize("count", [8, 200])
def test_ideal_rows_keep_a_finite_weight(count):
    log = gaussian_log(4, count=count)
    exact = replace(log, y=log.K @ log.truth)
    found = exact.observations().residual_covariance(log.truth, log.truth)
    assert np.all(np.linalg.eigvalsh(found) > 0)
    assert np.all(np.isfinite(np.linalg.inv(np.linalg.cholesky(found))))
    assert np.sqrt(np.diag(found)).max() < 1e-5 * np.abs(exact.y).max()


@pytest.mark.parametrize("inflation", [1.0, 4 / 3])
def test_the_residual_covariance_is_corrected_for_the_weights_that_it_gives(inflation):
    """By (N + n)/(N - n) for N independent rows of n coordinates."""
    log = replace(gaussian_log(5, count=200), inflation=inflation)
    residual = log.y - log.K @ log.truth
    rows, n = len(log) / inflation, log.K.shape[1]
    moment = residual.T @ residual / len(log) + 1e-10 * np.diag(np.mean(log.y**2, axis=0))
    expected = inflation * (rows + n) / (rows - n) * moment
    found = log.observations().residual_covariance(log.truth, log.truth)
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("inflation", [1.0, 4 / 3])
def test_correlations_need_three_independent_rows_per_coordinate(inflation):
    n = gaussian_log(5).K.shape[1]
    for count in (int(3 * n * inflation), int(3 * n * inflation) + 1):
        log = replace(gaussian_log(5, count=count), inflation=inflation)
        found = log.observations().residual_covariance(log.truth, log.truth)
        is_diagonal = not np.any(found - np.diag(np.diag(found)))
        assert is_diagonal is (count <= 3 * n * inflation)


@pytest.mark.parametrize("inflation", [1.0, 4 / 3])
@pytest.mark.parametrize("terms", [(), ("viscous", "coulomb", "offset")])
def test_a_coordinate_needs_five_rows_and_three_per_parameter_of_its_own(inflation, terms):
    log = replace(gaussian_log(6, count=60, terms=terms), inflation=inflation)
    coordinate = log.K.shape[1] - 1
    structure = np.any(log.K != 0, axis=0)
    own = np.sum(structure[coordinate] & (structure.sum(axis=0) == 1))
    assert own >= len(terms)
    needed = (5 + 3 * own) * inflation
    for count in (int(np.ceil(needed)) - 1, int(np.ceil(needed))):
        valid = log.valid.copy()
        valid[count:, coordinate] = False
        variance = np.diag(
            replace(log, valid=valid).observations().residual_covariance(log.truth, log.truth)
        )
        assert (variance[coordinate] > 1e3 * variance[:coordinate].max()) is np.bool_(
            count < needed
        )


def test_whiteness_is_the_largest_ratio_of_variances_over_chance():
    """Against dense moments of logs whose residuals are known."""
    short, long = (
        replace(gaussian_log(7, count=count), window=window, inflation=4 / 3)
        for count, window in ((400, 0.08), (200, 0.24))
    )
    moments = []
    for log in (short, long):
        residual = log.y - log.K @ log.truth
        moments.append(residual.T @ residual / len(log))
    largest = eigh(moments[1], moments[0], eigvals_only=True)[-1]
    n = short.K.shape[1]
    chance = (1 + np.sqrt(n / (200 * 3 / 4))) ** 2
    found = whiteness(short.observations(), long.observations(), short.truth)
    assert found == pytest.approx(3 * largest / chance, rel=1e-6)


def test_overlap_reduces_the_number_of_rows():
    log = gaussian_log(5, count=6000)
    plain, overlapping = (
        replace(log, inflation=inflation).observations().residual_covariance(log.truth, log.truth)
        for inflation in (1.0, 4 / 3)
    )
    np.testing.assert_allclose(overlapping / plain, 4 / 3, rtol=5e-3)


def test_noise_is_limited_by_the_residuals():
    log = gaussian_log(6, count=300).with_noisy_regressor(np.random.default_rng(6), 1e-4)
    observations = log.observations()
    covariance = observations.residual_covariance(log.truth, log.truth)
    assert observations.plausible_noise(log.truth, covariance) == 1
    louder = replace(log, noise_rows=1e3 * log.noise_rows).observations()
    share = louder.plausible_noise(log.truth, covariance)
    assert 0 < share < 1
    moment = share * louder.inflation * louder.noise.residual_moment(log.truth) / len(log)
    largest = np.linalg.eigvals(np.linalg.solve(covariance, moment)).real.max()
    assert largest == pytest.approx(CHANCE, rel=1e-6)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(1, 59), max_size=4))
def test_merging_is_the_same_as_folding(seed, cuts):
    log = masked(gaussian_log(seed % 3), seed).with_noisy_regressor(
        np.random.default_rng(seed), 0.1
    )
    edges = [0, *sorted(set(cuts)), len(log)]
    parts = [log[a:b].observations() for a, b in pairwise(edges)]
    merged = parts[-1]
    for part in parts[:-1]:
        merged = merged.merge(part)
    whole = log.observations()
    np.testing.assert_array_equal(merged.counts, whole.counts)
    for one, other in ((merged.rows, whole.rows), (merged.noise, whole.noise)):
        assert one.samples == other.samples == len(log)
        expected = other.residual_moment(log.truth)
        found = one.residual_moment(log.truth)
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_merging_does_not_modify_its_inputs():
    one, other = gaussian_log(1)[:30].observations(), gaussian_log(1)[30:].observations()
    factors = [part.factor for part in (one.rows, one.noise, other.rows, other.noise)]
    before = [factor.copy() for factor in factors]
    one.merge(other)
    for factor, expected in zip(factors, before, strict=True):
        np.testing.assert_array_equal(factor, expected)


def test_other_windows_and_other_robots_are_not_merged():
    log = gaussian_log(7)
    with pytest.raises(EstimateError, match=r"windows of 0\.321 s cannot be added .* 0\.081 s"):
        log.observations().merge(replace(log, window=0.321).observations())
    with pytest.raises(DataError, match="different robots"):
        log.observations().merge(gaussian_log(8, links=4).observations())


def windows(seed, drift, count=3200, seldom=None):
    """Return the same residuals averaged over windows of one and of four lengths.

    The last coordinate has only as many long windows as ``seldom``, if this is given.
    """
    log = gaussian_log(9, count=count)
    root = noise_root(np.random.default_rng(9), log.K.shape[1])
    log = log.measured(np.random.default_rng(seed), root)
    e = log.y - log.K @ log.truth + drift * np.ones(log.K.shape[1])
    K = log.K.reshape(-1, 4, *log.K.shape[1:]).mean(axis=1)
    short = replace(log, y=log.K @ log.truth + e, window=0.1)
    long = replace(
        log[: len(K)], K=K, y=K @ log.truth + e.reshape(-1, 4, e.shape[1]).mean(axis=1), window=0.4
    )
    if seldom is not None:
        short, long = (
            replace(one, valid=(np.arange(len(one)) < rows)[:, None] | ~last)
            for last in [np.arange(e.shape[1]) == e.shape[1] - 1]
            for one, rows in ((short, 4 * seldom), (long, seldom))
        )
    return short.observations(), long.observations(), log.truth


def test_white_noise_is_white():
    for seed in range(5):
        assert 0.7 < whiteness(*windows(seed, 0.0)) < 1.1


def test_constant_residuals_outlast_noise_by_the_ratio_of_windows():
    short, long, truth = windows(0, 0.0)
    chance = (1 + np.sqrt(len(long.counts) / long.rows.samples)) ** 2
    # What lasts shows in one combination of coordinates, and keeps all of its variance there.
    assert whiteness(*windows(1, 1e3)) == pytest.approx(4 / chance, rel=0.01)
    drifting = [whiteness(*windows(1, drift)) for drift in (0.0, 0.5, 1.0, 4.0)]
    assert drifting == sorted(drifting)
    # Wrong parameters are as lasting as a wrong sensor where the motion is slow.
    assert whiteness(short, long, 1.5 * truth) > 1.5


def test_a_coordinate_with_few_rows_does_not_hide_what_lasts_in_the_others():
    """As a joint of a leg that seldom swings."""
    for seed in range(5):
        assert whiteness(*windows(seed, 0.0, seldom=8)) < 1.1
    assert whiteness(*windows(1, 1e3, seldom=8)) > 0.9 * whiteness(*windows(1, 1e3))


@pytest.mark.parametrize("count", [40, 80, 100, 400])
def test_noise_of_short_logs_is_white(count):
    """Long windows may be too few for correlations where short ones are not."""
    assert max(whiteness(*windows(seed, 0.0, count)) for seed in range(20)) < 1.2


def test_residuals_of_rounding_raise_no_alarm():
    log = gaussian_log(9, count=3200)
    exact = replace(log, y=log.K @ log.truth, window=0.1)
    quarter = replace(exact[:800], window=0.4)
    assert whiteness(exact.observations(), quarter.observations(), log.truth) < 1.1
    none = replace(exact, K=0 * exact.K, y=0 * exact.y)
    longer = replace(none[:800], window=0.4)
    assert whiteness(none.observations(), longer.observations(), log.truth) < 1.1


@pytest.mark.parametrize("excess", [0.0, 1e-13, 1e-11, 1e-9, 5e-9])
def test_a_moment_that_rounding_made_indefinite_changes_only_on_its_diagonal(excess):
    moment = np.array([[1.0, 1.0 + excess], [1.0 + excess, 1.0]])
    found = definite(moment)
    np.linalg.cholesky(found)
    assert found[0, 1] == moment[0, 1], "residuals stay correlated"
    np.testing.assert_allclose(np.diag(found), 1.0, atol=1e-8)


@pytest.mark.parametrize("inflation", [1.0, 4 / 3])
def test_the_fitted_share_is_the_trace_of_the_hat_matrix(inflation):
    log = replace(masked(gaussian_log(2, count=90), 2), inflation=inflation)
    prior = prior_of(log, 2)
    found = posterior(log.observations(), prior)
    K = log.K * log.valid[:, :, None]
    weight = np.linalg.inv(found.covariance)
    H = np.einsum("tia,ij,tjb->ab", K, weight, K)
    variances = np.linalg.inv(H + np.diag(prior.std**-2.0))
    hat = np.einsum("tia,ab,tjb,ji->i", K, variances, K, weight)
    share = log.observations().fitted_share(variances, found.covariance)
    np.testing.assert_allclose(share, hat / (log.valid.sum(axis=0) / inflation), rtol=1e-9)
    assert np.sum(share * log.valid.sum(axis=0) / inflation) <= len(prior.std)


def test_few_rows_in_a_wide_factor_are_all_used():
    """A row of the factor may have content to the right of an empty column."""
    log = gaussian_log(5, count=50)
    full = log.observations().rows
    factor = np.triu(np.random.default_rng(5).normal(size=full.factor.shape))
    factor[:, ::3] = 0.0
    sparse = replace(full, factor=factor)
    G = np.linalg.inv(noise_root(np.random.default_rng(5), len(full.layout.coordinates)))
    R = sparse.whitened(G)
    expected = sparse.whitened_moment(G.T @ G)
    np.testing.assert_allclose(R.T @ R, expected, atol=1e-9 * np.abs(expected).max())


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 70), min_size=1, max_size=6))
def test_few_rows_are_kept_as_they_are_and_many_in_a_triangle(seed, counts):
    """Rows in batches of any size give the moments of all of them, before and after width w."""
    log = gaussian_log(seed, count=sum(counts), links=2)
    rows, layout = log.rows().mean, log.layout
    found, first = Information.empty(layout), 0
    for count in counts:
        found = found.fold([log[first : first + count].rows().mean])
        first += count
    assert len(found.factor) == min(first, layout.width)
    flat = layout.flatten([rows])
    gram = flat.T @ flat
    close = partial(np.testing.assert_allclose, rtol=0, atol=1e-11 * gram.max())
    close(found.factor.T @ found.factor, gram)
    dense = np.concatenate([rows.K, rows.y[..., None]], axis=2)
    whitening = noise_root(np.random.default_rng(seed), len(layout.coordinates))
    whitened = (whitening @ dense).reshape(-1, dense.shape[2])
    scale = np.abs(whitened.T @ whitened).max()
    for moment in (
        found.whitened_moment(whitening.T @ whitening),
        (R := found.whitened(whitening)).T @ R,
    ):
        np.testing.assert_allclose(moment, whitened.T @ whitened, rtol=0, atol=1e-11 * scale)
    for coordinate, columns in enumerate(layout.columns):
        own = dense[:, coordinate, np.append(columns, -1)]
        factor = found.coordinate_factors[coordinate]
        close(factor.T @ factor, own.T @ own)
    few = layout.parameters[::2]
    some = found.restricted(few)
    part = some.layout.flatten([Rows(rows.K[..., ::2], rows.y)])
    close(some.factor.T @ some.factor, part.T @ part)
    merged = found.merge(found.discounted(0.25))
    close(merged.factor.T @ merged.factor, 1.25 * gram)


def test_no_rows_have_no_moment(capfd):
    """BLAS writes messages about matrices without rows."""
    empty = Information.empty(gaussian_log(5, count=50).observations().rows.layout)
    assert not empty.whitened_moment(np.eye(len(empty.layout.coordinates))).any()
    assert not empty.whitened(np.eye(len(empty.layout.coordinates))).any()
    assert capfd.readouterr() == ("", "")
