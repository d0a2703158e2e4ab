"""Posterior against prior: dense algebra, invariances and properties of the information."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from symbid_ros.errors import EstimateError, PriorError
from symbid_ros.estimation.directions import DETERMINED, count_determined, determined_directions
from symbid_ros.model.inertia import PARAMETERS

NAMES = (
    *(f"{link}/{name}" for link in ("thigh", "shank") for name in PARAMETERS),
    "knee/viscous",
)
P = len(NAMES)
# kg beside kg m²: what an identified leg looks like.
SCALE = np.r_[np.tile(np.repeat([5.0, 0.5, 0.05], [1, 3, 6]), 2), 0.3]

seeds = st.integers(0, 10**6)
row_counts = st.integers(0, 2 * P)
few = settings(max_examples=40, deadline=None)


def problem(seed, rows, *, correlated=True, noise=0.3):
    """Return factors of a prior, and of its posterior after random linear measurements."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(P, P)) * 0.1 if correlated else np.zeros((P, P))
    prior = SCALE[:, None] * (np.eye(P) + mixing)
    whitened_rows = rng.normal(size=(rows, P)) @ np.diag(np.logspace(0, -3, P)) / noise
    precision_factor = np.linalg.qr(np.vstack([whitened_rows, np.eye(P)]), mode="r")
    return prior, prior @ np.linalg.inv(precision_factor)


def compare(prior, posterior, threshold=0.5):
    return determined_directions(prior, posterior, NAMES, threshold)


@few
@given(seeds, row_counts)
def test_directions_diagonalise_both_covariances(seed, rows):
    prior, posterior = problem(seed, rows)
    found = compare(prior, posterior)
    before, after = prior @ prior.T, posterior @ posterior.T
    unit = np.sqrt(np.outer(np.diag(before), np.diag(before)))
    D, C = found.directions, found.coordinates
    np.testing.assert_allclose(C @ D, np.eye(P), atol=1e-11)
    np.testing.assert_allclose(D @ D.T / unit, before / unit, atol=1e-12)
    np.testing.assert_allclose(D * found.ratios**2 @ D.T / unit, after / unit, atol=1e-12)
    squares = eigh(after / unit, before / unit, eigvals_only=True)
    np.testing.assert_allclose(found.ratios**2, np.maximum(squares, 0), atol=1e-9)
    assert np.all(np.diff(found.ratios) >= 0)


@few
@given(seeds, row_counts)
def test_gain_is_the_ratio_of_determinants_and_the_counts_agree(seed, rows):
    prior, posterior = problem(seed, rows)
    found = compare(prior, posterior)
    before, after = (np.linalg.slogdet(factor)[1] for factor in (prior, posterior))
    assert found.gain == pytest.approx((before - after) / np.log(2), abs=1e-9)
    assert found.gain >= 0
    # trace(I - P P₀⁻¹): the effective number in its usual form.
    resolution = np.trace(np.eye(P) - posterior @ posterior.T @ np.linalg.inv(prior @ prior.T))
    assert found.effective == pytest.approx(resolution, abs=1e-8)
    assert np.sum(found.determined) <= found.effective / (1 - found.threshold**2) + 1e-9
    assert np.sum(found.determined) <= rows
    same = compare(prior, posterior, DETERMINED).determined
    assert count_determined(prior, posterior) == np.sum(same)


@few
@given(seeds, row_counts)
def test_each_links_gain_is_that_of_its_marginals_and_never_exceeds_the_whole(seed, rows):
    prior, posterior = problem(seed, rows, correlated=False)
    found = compare(prior, posterior)
    assert list(found.link_gain) == ["thigh", "shank"]
    for link, block in (("thigh", slice(0, 10)), ("shank", slice(10, 20))):
        before, after = (
            np.linalg.slogdet((factor @ factor.T)[block, block])[1] for factor in (prior, posterior)
        )
        assert found.link_gain[link] == pytest.approx((before - after) / 2 / np.log(2), abs=1e-8)
        assert found.link_gain[link] >= 0
    # Independent in the prior, links can only hide information in their correlation.
    assert sum(found.link_gain.values()) <= found.gain + 1e-9


@few
@given(seeds, st.integers(1, P))
def test_units_and_the_choice_of_factors_change_nothing(seed, rows):
    rng = np.random.default_rng(seed)
    prior, posterior = problem(seed, rows)
    units = 10.0 ** rng.uniform(-4, 4, P)[:, None]
    turns = [np.linalg.qr(rng.normal(size=(P, P)))[0] for _ in range(2)]
    found = compare(prior, posterior)
    other = compare(units * prior @ turns[0], units * posterior @ turns[1])
    np.testing.assert_allclose(other.ratios, found.ratios, rtol=1e-9)
    assert other.effective == pytest.approx(found.effective, abs=1e-9)
    assert other.link_gain == pytest.approx(found.link_gain, abs=1e-8)
    # What the data leave alone has no direction of its own; the seen ones must agree.
    seen = slice(0, min(rows, 3))
    np.testing.assert_allclose(other.loadings[:, seen], found.loadings[:, seen], atol=1e-6)


@few
@given(seeds, row_counts)
def test_loadings_are_correlations_under_the_prior(seed, rows):
    found = compare(*problem(seed, rows))
    np.testing.assert_allclose(np.sum(found.loadings**2, axis=1), 1, rtol=1e-10)


def test_no_data_determine_nothing():
    prior, _ = problem(1, 0)
    found = compare(prior, prior)
    assert not found.determined.any()
    assert found.gain == pytest.approx(0, abs=1e-12)
    assert found.effective == pytest.approx(0, abs=1e-12)
    assert found.link_gain == pytest.approx({"thigh": 0, "shank": 0}, abs=1e-12)


def test_more_data_narrow_every_direction():
    prior, posterior = problem(2, 6)
    less = compare(prior, posterior)
    rng = np.random.default_rng(3)
    rows = np.vstack([rng.normal(size=(4, P)) / SCALE, np.linalg.inv(posterior)])
    more = compare(prior, np.linalg.inv(np.linalg.qr(rows, mode="r")))
    assert np.all(more.ratios <= less.ratios + 1e-12)
    assert more.gain > less.gain


def test_one_measured_sum_is_the_one_direction_found():
    prior = np.diag(SCALE)
    masses = [NAMES.index("thigh/m"), NAMES.index("shank/m")]
    row = np.zeros(P)
    row[masses] = 1 / 0.05
    rows = np.vstack([row, np.linalg.inv(prior)])
    found = compare(prior, np.linalg.inv(np.linalg.qr(rows, mode="r")))
    assert np.sum(found.determined) == 1
    # The sum's deviation falls from 5√2 kg to that of a weighing to .05 kg.
    assert found.ratios[0] == pytest.approx(1 / np.sqrt(1 + (5 * np.sqrt(2) / 0.05) ** 2))
    assert found.describe(0) == "+0.71 thigh/m +0.71 shank/m"
    np.testing.assert_allclose(
        found.coordinates[0], row * 0.05 / (5 * np.sqrt(2)), atol=1e-12 / SCALE.min()
    )
    np.testing.assert_allclose(found.ratios[1:], 1)
    # Each mass alone is then known to √½ of its prior: half a bit.
    assert found.link_gain == pytest.approx({"thigh": 0.5, "shank": 0.5}, abs=1e-3)


def test_a_parameter_known_exactly_is_worth_infinitely_many_bits():
    prior = np.diag(SCALE)
    posterior = prior.copy()
    posterior[0, 0] = 0
    found = compare(prior, posterior)
    assert found.ratios[0] == 0
    assert found.gain == np.inf
    assert found.link_gain == {"thigh": np.inf, "shank": 0}
    assert found.effective == pytest.approx(1)


def test_the_leading_directions_are_described_by_their_loadings():
    prior = np.diag(SCALE)
    share = np.ones(P)
    share[[0, 3, 12]] = 0.01, 0.2, 0.4
    found = compare(prior, prior * share)
    assert np.sum(found.determined) == 3
    assert [found.describe(i) for i in range(2)] == ["+1.00 thigh/m", "+1.00 thigh/mc_z"]
    gains = {link: round(gain, 1) for link, gain in found.link_gain.items()}
    assert gains == {"thigh": 9.0, "shank": 1.3}


def test_a_singular_prior_is_rejected():
    prior = np.diag(SCALE)
    prior[4, 4] = 0
    with pytest.raises(PriorError, match="certain of thigh/Ixx"):
        compare(prior, prior)
    prior = np.diag(SCALE)
    prior[1, [1, 2]] = prior[2, [1, 2]] = 1.0
    with pytest.raises(PriorError, match="combination"):
        compare(prior, prior)


def test_a_posterior_wider_than_its_prior_has_gained_nothing():
    prior, posterior = problem(4, 5)
    found = compare(prior, 1e3 * prior)
    assert not found.determined.any()
    assert found.gain == 0.0
    posterior[0, 0] = np.nan
    with pytest.raises(EstimateError, match="not finite"):
        compare(prior, posterior)
