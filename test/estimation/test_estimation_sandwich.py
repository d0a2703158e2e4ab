"""Covariance under residuals that are correlated in time, against dense algebra and repetition."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log, prior_of

from symbid_ros.estimation import sandwich
from symbid_ros.estimation.archive import load_archive, write_archive
from symbid_ros.estimation.directions import determined_directions
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.sandwich import correlation_factors, with_correlated_residuals

SECONDS, COUNT = 40.0, 200
REPEATS = 5
NOISE = 0.01  # Nm and N
DETERMINED_BY_DATA = 0.1


def observations(log):
    """Return observations of a log with its stamps."""
    stamp = np.linspace(0.0, SECONDS, len(log)) * 1e9
    rows = replace(log.rows(), stamp=stamp.astype(np.int64))
    empty = Observations.empty(log.layout, log.window)
    return replace(empty, inflation=log.inflation).fold([rows])


def repeated(log):
    """Return the log with each row, residual included, several times in a row."""
    names = ("K", "y", "noise_rows", "noise_targets", "valid")
    many = {name: np.repeat(getattr(log, name), REPEATS, axis=0) for name in names}
    return replace(log, **many)


def measured(log, seed):
    """Return the log with other independent residuals."""
    return log.measured(np.random.default_rng(seed), NOISE * np.eye(log.y.shape[1]))


@pytest.fixture(scope="module", params=[True, False], ids=["floating", "fixed"])
def log(request):
    return gaussian_log(2, links=3, count=COUNT, floating=request.param)


def test_independent_residuals_leave_the_covariance(log):
    prior = prior_of(log, 0)
    ratios = []
    for seed in range(5):
        data = observations(measured(log, seed))
        found = posterior(data, prior)
        ratios.append(np.mean(with_correlated_residuals(found, data).std / found.std))
    assert min(ratios) >= 1.0
    assert np.mean(ratios) < 1.15


def test_intervals_cover_the_truth_despite_correlated_residuals(log):
    plain, honest = [], []
    for seed in range(12):
        prior = prior_of(log, seed)
        data = observations(repeated(measured(log, seed)))
        found = posterior(data, prior)
        known = determined_directions(
            prior.covariance_factor(), found.deviation_factor, prior.names, DETERMINED_BY_DATA
        )
        directions = known.coordinates[known.determined]
        error = directions @ (found.mean - log.truth)
        for each, posterior_of in (
            (plain, found),
            (honest, with_correlated_residuals(found, data)),
        ):
            variance = np.sum((directions @ posterior_of.deviation_factor) ** 2, axis=1)
            each.append(error**2 / variance)
    before, after = (np.mean(np.concatenate(each)) for each in (plain, honest))
    assert before > 2 * after
    assert 0.5 < after < 1.6


def test_the_covariance_is_the_sandwich_of_dense_algebra(log, monkeypatch):
    """Each combination of residuals has the mean factor of its coordinates."""
    prior = prior_of(log, 1, related=True)
    data = observations(log)
    found = posterior(data, prior)
    n = log.y.shape[1]
    factors = np.linspace(1.0, 9.0, n)
    monkeypatch.setattr(sandwich, "correlation_factors", lambda *_: factors)
    honest = with_correlated_residuals(found, data)
    deviation = np.sqrt(np.diag(found.covariance))
    size, V = np.linalg.eigh(found.covariance / np.outer(deviation, deviation))
    root = deviation[:, None] * V
    true = (root * size * (factors @ V**2)) @ root.T
    weight = np.linalg.inv(found.covariance)
    score = np.einsum("tip,ij,jk,kl,tlq->pq", log.K, weight, true, weight, log.K, optimize="greedy")
    L0 = prior.covariance_factor()
    score = score + np.linalg.inv(L0 @ L0.T)
    bread = np.linalg.inv(found.factor.T @ found.factor)
    expected = bread @ score @ bread
    scale = np.sqrt(np.diag(expected))
    covariance = honest.deviation_factor @ honest.deviation_factor.T
    np.testing.assert_allclose(
        covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )
    np.testing.assert_array_equal(honest.mean, found.mean)


def test_data_of_earlier_versions_have_no_factors(log):
    data = replace(observations(log), groups=None)
    found = posterior(data, prior_of(log, 0))
    np.testing.assert_array_equal(correlation_factors(found, data), 1.0)
    assert with_correlated_residuals(found, data) is found


def test_factors_survive_archives_merging_and_discounting(log, tmp_path):
    one, two = (observations(repeated(measured(log, seed))) for seed in range(2))
    write_archive(tmp_path / "information.npz", [one])
    (read,) = load_archive(tmp_path / "information.npz")
    phi = log.truth
    np.testing.assert_allclose(read.correlation(phi), one.correlation(phi), rtol=1e-12)
    assert one.correlation(phi).max() > 2.0
    both = read.merge(two)
    np.testing.assert_allclose(both.correlation(phi), two.merge(one).correlation(phi))
    # The discounted rows claim less than they tell.
    discounted = both.discounted(0.5).correlation(phi)
    np.testing.assert_allclose(discounted, np.maximum(0.5 * both.correlation(phi), 1.0))
