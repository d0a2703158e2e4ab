"""The posterior: against stacked rows in dense algebra, invariances and calibration."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from gaussian_logs import gaussian_log, noise_root, prior_of, scattered
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, eigh
from scipy.optimize import minimize, minimize_scalar

from symbid_ros.choices import TERMS
from symbid_ros.estimation import posterior as production
from symbid_ros.estimation import quadratic_cost
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior
from symbid_ros.estimation.prior import default_prior
from symbid_ros.estimation.prior_scales import (
    NARROWING_STD,
    PARTS_STD,
    RATIO_STD,
    PriorEvidence,
)

few = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 10**6)


def residual_moment(log, K, y, phi):
    """Return the mean of e e.T, row by row, of what is always seen together, and how many are."""
    n = K.shape[1]
    e = np.where(log.valid, y - K @ phi, 0.0)
    used = log.valid.astype(float)
    moment, counts = e.T @ e, used.T @ used
    always = log.valid.all(axis=0) & (len(log) > 3 * n * log.inflation)
    together = np.outer(always, always) | np.eye(n, dtype=bool)
    return np.where(together, moment / np.maximum(counts, 1), 0.0), int(always.sum())


def least_variance(log):
    """Return what is always added to the variances of residuals (n,)."""
    square = np.sum((log.y * log.valid) ** 2, axis=0) / np.maximum(log.valid.sum(axis=0), 1)
    return 1e-10 * square + 1e-14 * square.max()


def dense_posterior(log, prior, known=None):
    """Return mean, covariance and Σ from all rows stacked, in the prior's deviations."""
    p, n = len(log.truth), log.K.shape[1]
    L = prior.covariance_factor() / prior.std[:, None]
    P = L @ L.T
    seen = log.valid[:, :, None]
    K, dK = ((part * seen * prior.std) for part in (log.K, log.noise_rows))
    y, dy = log.y * log.valid, log.noise_targets * log.valid
    about, x = prior.mean / prior.std, prior.mean / prior.std
    for _ in range(200):
        S, coupled = residual_moment(log, K, y, x)
        S += np.diag(least_variance(log))
        independent = len(log) / log.inflation
        S = log.inflation * S * (independent + coupled) / (independent - coupled)
        noise = log.inflation * residual_moment(log, dK, dy, x)[0]
        share = 1 / max(eigh(noise, S, eigvals_only=True)[-1], 1.0)
        W = np.linalg.inv(S)
        H, g = np.linalg.inv(P), np.linalg.solve(P, about)
        for sign, rows, targets in ((1.0, K, y), (-share, dK, dy)):
            weighted = np.einsum("ij,tja->tia", W, rows, optimize=True)
            H = H + sign * np.einsum("tia,tib->ab", weighted, rows, optimize=True)
            g = g + sign * np.einsum("tia,ti->a", weighted, targets, optimize=True)
        if known is not None:
            rows = known.rows * prior.std
            H, g = H + rows.T @ rows, g + rows.T @ known.targets
        # Noise that is taken off leaves no direction with less than the prior.
        told, axes = np.linalg.eigh(L.T @ H @ L)
        axes, least = L @ axes, np.maximum(told, 1.0)
        step = np.linalg.solve(axes, np.linalg.solve(H, g) - about)
        before, x = x, about + axes @ (told / least * step)
        if np.abs(x - before).max() < 1e-12 * np.abs(x).max():
            break
    assert W.shape == (n, n)
    assert H.shape == (p, p)
    return x * prior.std, (axes / least) @ axes.T * np.outer(prior.std, prior.std), S


def log_evidence(log, prior, known, covariance, scale):
    """Return the log probability of all rows at once, without whitening or compression."""
    L = scale * prior.covariance_factor()
    seen = log.valid.ravel()
    W, y = log.K.reshape(len(seen), -1)[seen], log.y.ravel()[seen]
    noise = block_diag(*[covariance] * len(log))[np.ix_(seen, seen)]
    if known is not None:
        W, y = np.concatenate([W, known.rows]), np.append(y, known.targets)
        noise = block_diag(noise, np.eye(len(known.targets)))
    total = noise + W @ L @ L.T @ W.T
    e = y - W @ prior.mean
    return -0.5 * (np.linalg.slogdet(total)[1] + e @ np.linalg.solve(total, e))


def assert_posterior(found, mean, covariance, tolerance=1e-6):
    """Assert equality in units of the reference's standard deviations."""
    root = np.linalg.cholesky(covariance / np.outer(std := np.sqrt(np.diag(covariance)), std))
    error = np.linalg.solve(root, (found.mean - mean) / std)
    assert np.linalg.norm(error) < tolerance
    ratio = np.linalg.solve(root, found.deviation_factor / std[:, None])
    np.testing.assert_allclose(ratio @ ratio.T, np.eye(len(mean)), atol=tolerance)
    np.testing.assert_allclose(found.std, std, rtol=tolerance)


def weighing(log):
    row = np.zeros(len(log.truth))
    row[: log.parameters.inertial : 10] = 50.0
    return PseudoMeasurements(row[None], np.array([row @ log.truth]))


CASES = {
    "plain": {},
    "correlated prior": {"related": True},
    "fixed base": {"floating": False},
    "weighed": {"weighed": True},
    "masked": {"masked": True},
    "friction, masked": {"masked": True, "terms": TERMS},
    "noisy motion": {"noisy": 0.002},
    "noisy motion, masked, weighed": {
        "noisy": 0.002,
        "masked": True,
        "weighed": True,
        "related": True,
    },
    "overlapping windows": {"inflation": 4 / 3},
    "fewer samples than parameters": {"count": 20},
}


def case(seed, *, count=150, floating=True, terms=(), inflation=1.0, **kind):
    """Return a log, a prior and what is known beside them."""
    rng = np.random.default_rng([seed, 1])
    log = gaussian_log(seed, count=count, floating=floating, terms=terms)
    log = replace(log, inflation=inflation)
    if noisy := kind.get("noisy"):
        log = log.with_noisy_regressor(rng, noisy)
        log = replace(log, noise_targets=noisy * rng.normal(size=log.y.shape))
    if kind.get("masked"):
        valid = log.valid.copy()
        valid[:, -2:] = rng.random((count, 2)) < 0.6
        log = replace(log, valid=valid)
    prior = prior_of(log, seed, related=kind.get("related", False))
    return log, prior, weighing(log) if kind.get("weighed") else None


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", CASES)
def test_the_factor_gives_what_stacked_rows_give(name, seed, monkeypatch):
    log, prior, known = case(seed, **CASES[name])
    mean, covariance, sigma = dense_posterior(log, prior, known)
    # As few iterations as users get come near enough, the more so without noise in the motion.
    assert_posterior(posterior(log.observations(), prior, known), mean, covariance, 1e-2)
    monkeypatch.setattr(production, "REWHITENINGS", 200)
    found = posterior(log.observations(), prior, known)
    assert_posterior(found, mean, covariance)
    size = np.sqrt(np.diag(sigma))
    unit = np.outer(size, size)
    np.testing.assert_allclose(found.covariance / unit, sigma / unit, atol=1e-6)
    if not log.noise_rows.any():
        assert found.noise_share == 0
    else:
        assert 0.001 < found.noise_share < 0.75


@pytest.mark.parametrize("empirical", [False, True])
@pytest.mark.parametrize("name", [*CASES, "noise beyond what is subtracted"])
def test_comparisons_have_half_of_the_digits(name, empirical, monkeypatch):
    monkeypatch.setattr(production, "REWHITENINGS", 200)
    monkeypatch.setattr(production, "APPROXIMATE_TURNS", 200)
    if name.startswith("noise beyond"):
        monkeypatch.setattr(quadratic_cost, "MAX_NOISE_SHARE", 0.2)
    log, prior, known = case(1, **CASES.get(name, {"noisy": 0.5}))
    observations = log.observations()
    whole = posterior(observations, prior, known, empirical=empirical)
    near = posterior(
        observations, prior, known, empirical=empirical, approximate=True, tolerance=1e-6
    )
    covariance = whole.deviation_factor @ whole.deviation_factor.T
    assert_posterior(near, whole.mean, covariance, 1e-4)
    assert near.noise_share == pytest.approx(whole.noise_share, rel=1e-4)
    assert near.prior_scale == pytest.approx(whole.prior_scale, rel=1e-4)
    assert near.chosen_scale == pytest.approx(whole.chosen_scale, rel=1e-4)
    if name.startswith("noise beyond"):
        assert whole.noise_share > 0.2


def narrowing(logs):
    """Half the squares of factors below one, in deviations of their logarithms."""
    return np.sum((np.minimum(logs, 0.0) / NARROWING_STD) ** 2) / 2


def test_one_direction_does_not_narrow_the_prior_of_all():
    """The stated value happens to be right in the only direction that the data know."""
    known = PriorEvidence(np.array([[1000.0, 0.0, 0.0]]), np.zeros(1))
    assert 0.3 < known.common_scale() < 1.0
    logs = known.scales([np.sqrt(0.5) * np.eye(3)] * 2)
    assert np.all((np.exp(logs) > 0.3) & (np.exp(logs) < 1.0))
    # Many such directions are evidence.
    assert PriorEvidence(1000.0 * np.eye(50), np.zeros(50)).common_scale() < 0.1


def test_rounding_does_not_change_what_directions_without_rows_get_back():
    """Where no row shows anything, eigenvectors of the information are arbitrary."""
    log, *_ = case(5, floating=False, terms=("viscous", "coulomb"))
    exact = default_prior(log.parameters)
    rng = np.random.default_rng(0)
    found = []
    for _ in range(4):
        y = log.y * (1 + 1e-10 * rng.normal(size=log.y.shape))
        observations = replace(log, y=y).observations()
        inertial = log.parameters.inertial
        found.append(posterior(observations, exact, empirical=True, count=inertial))
    assert found[0].unseen is not None
    for other in found[1:]:
        np.testing.assert_allclose(other.std, found[0].std, rtol=1e-4)


@pytest.mark.filterwarnings("error")
def test_data_that_say_nothing_leave_the_prior_as_stated():
    nothing = PriorEvidence(1e-18 * np.ones((2, 3)), 1e-3 * np.ones(2))
    logs = nothing.scales([np.eye(3), 2 * np.eye(3), np.eye(3)[:, :1]], np.zeros(3))
    np.testing.assert_allclose(logs, 0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["plain", "correlated prior", "weighed", "masked"])
def test_the_evidence_is_that_of_all_rows_at_once(name, monkeypatch):
    monkeypatch.setattr(quadratic_cost, "WEAK_INFORMATION", 0)
    log, prior, known = case(3, count=40, **CASES[name])
    for misjudged in (0.2, 5.0):
        wrong = prior.widened(np.full(len(prior.std), misjudged))
        found = posterior(log.observations(), wrong, known)

        def cost(log_scale, wrong=wrong, covariance=found.covariance):
            likely = log_evidence(log, wrong, known, covariance, np.exp(log_scale))
            return narrowing(log_scale) - likely

        grid = np.linspace(np.log(1e-2), np.log(1e2), 60)
        best = int(np.argmin([cost(point) for point in grid]))
        bounds = (grid[best - 1], grid[best + 1])
        expected = np.exp(minimize_scalar(cost, bounds=bounds, method="bounded").x)
        assert found.prior_scale == pytest.approx(expected, rel=1e-3)
        # Too wide a prior is told to shrink, too narrow a one to grow.
        assert (found.prior_scale > 1) == (misjudged < 1)


def test_what_the_data_hardly_know_does_not_widen_the_prior_alone(monkeypatch):
    """A small effect that the model lacks looks like a thousand deviations of one parameter."""
    log, prior, _ = case(6, count=200)
    truth = log.parameters.values
    prior = scattered(prior, truth, np.random.default_rng(6))
    without = posterior(log.observations(), prior, empirical=True)
    place = 1  # of a first moment
    column = log.K[:, :, place]
    # Unlike the columns of the others, which could explain it.
    weak = np.random.default_rng(7).normal(size=column.shape) * (column != 0)
    precision = np.linalg.inv(without.covariance)
    information = prior.std[place] ** 2 * np.einsum("ti,ij,tj->", weak, precision, weak)
    weak *= np.sqrt(5e-4 / information)
    K, effect = log.K.copy(), 1000 * prior.std[place] * weak
    K[:, :, place] = weak
    unlike = replace(log, K=K, y=log.y + (weak - column) * truth[place] + effect)
    found = posterior(unlike.observations(), prior, empirical=True)
    assert found.chosen_scale == pytest.approx(without.chosen_scale, rel=0.3)
    assert abs(found.mean - prior.mean)[place] < prior.std[place]
    # The same effect in a direction that the data know is a wrong prior.
    monkeypatch.setattr(quadratic_cost, "WEAK_INFORMATION", 0)
    assert posterior(unlike.observations(), prior, empirical=True).chosen_scale > 10


@pytest.mark.parametrize("beyond", [0, 10])
def test_an_empirical_prior_is_as_wide_as_the_evidence_says(beyond):
    """The scale is that of the first parameters alone, and the remaining scale is 1."""
    log, prior, _ = case(4, count=200)
    count = len(prior.std) - beyond
    wrong = prior.widened(np.where(np.arange(len(prior.std)) < count, 1 / 7, 1.0))
    found = posterior(log.observations(), wrong, empirical=True, count=count)
    scale = found.prior.std / wrong.std
    np.testing.assert_allclose(scale[:count], scale[0])
    np.testing.assert_array_equal(scale[count:], 1.0)
    assert found.prior_scale == pytest.approx(1, rel=1e-3)
    # Given as an ordinary prior, the same deviations give the same answer.
    again = posterior(log.observations(), found.prior, count=count)
    assert_posterior(again, found.mean, found.deviation_factor @ found.deviation_factor.T, 1e-5)
    assert again.prior_scale == pytest.approx(1, rel=1e-2)
    # Twenty or thirty parameters tell their own spread to about a fifth.
    assert 0.5 < scale[0] / 7 < 1.8


@pytest.mark.parametrize("sizes", [(1.0, 4.0, 1.0), (50.0, 1.0, 10.0), (0.1, 0.1, 50.0)])
def test_each_kind_of_error_gets_the_size_that_the_evidence_says(sizes):
    """The factors are the most probable ones given all rows at once."""
    log = gaussian_log(11, count=40)
    stated = default_prior(log.parameters)
    numbers = [np.diag(each**2) for each in stated.alone]
    kinds = [stated.factor @ stated.factor.T - sum(numbers), *numbers]

    def sized(logs):
        covariance = np.tensordot(np.exp(2 * np.asarray(logs)), kinds, 1)
        std = np.sqrt(np.diag(covariance))
        root = std[:, None] * np.linalg.cholesky(covariance / np.outer(std, std))
        return replace(stated, std=std, factor=root, alone=None)

    stated = replace(
        stated, mean=scattered(sized(np.log(sizes)), log.truth, np.random.default_rng(3)).mean
    )
    found = posterior(log.observations(), stated, empirical=True)

    def cost(logs):
        ratio, parts = (logs[0] - logs[1]) / RATIO_STD, logs[2] / PARTS_STD
        likely = log_evidence(log, sized(logs), None, found.covariance, 1.0)
        return narrowing(logs[:2]) + ratio**2 / 2 + parts**2 / 2 - likely

    best = minimize(cost, np.log(sizes), method="Nelder-Mead", options={"xatol": 1e-4})
    expected = sized(best.x)
    np.testing.assert_allclose(found.prior.std, expected.std, rtol=1e-3)
    again = posterior(log.observations(), found.prior)
    alone = found.independent_factor  # not widened where the data show nothing
    assert_posterior(again, found.mean, alone @ alone.T, 1e-4)
    size = np.sqrt(np.mean((found.prior.std / stated.std) ** 2))
    assert found.chosen_scale == pytest.approx(size)


@pytest.mark.parametrize("related", [False, True])
def test_without_data_the_prior_remains(related):
    log = gaussian_log(5)
    prior = prior_of(log, 5, related=related)
    for nothing in (Observations.empty(log.layout, 0.081), log[:0].observations()):
        found = posterior(nothing, prior)
        np.testing.assert_allclose(found.mean, prior.mean, rtol=1e-12)
        np.testing.assert_allclose(found.std, prior.std, rtol=1e-9)
        assert found.gain(len(prior.std)) == pytest.approx(0, abs=1e-9)
        assert found.noise_share == 0


def test_rows_without_excitation_leave_the_prior():
    log = gaussian_log(6)
    still = replace(log, K=np.zeros_like(log.K))
    prior = prior_of(log, 6)
    found = posterior(still.observations(), prior)
    np.testing.assert_allclose(found.mean, prior.mean, rtol=1e-12)
    np.testing.assert_allclose(found.std, prior.std, rtol=1e-9)


@few
@given(seeds, st.integers(0, 80), st.floats(0, 3), st.booleans())
def test_the_posterior_is_never_wider_than_the_prior(seed, count, noisy, related):
    """This holds for any subtracted noise, because the noise is only an estimate."""
    log = gaussian_log(seed % 7, count=80)[:count]
    log = log.with_noisy_regressor(np.random.default_rng(seed), noisy)
    prior = prior_of(log, seed, related=related)
    found = posterior(log.observations(), prior)
    ratio = np.linalg.solve(prior.covariance_factor(), found.deviation_factor)
    assert np.linalg.svd(ratio, compute_uv=False).max() < 1 + 1e-9
    assert np.all(np.isfinite(found.mean))
    assert found.gain(len(prior.std)) > -1e-9
    assert found.noise_share >= 0


@few
@given(seeds, st.lists(st.integers(1, 79), max_size=5), st.randoms(use_true_random=False))
def test_observations_may_be_merged_in_any_order(seed, cuts, random):
    log = gaussian_log(seed % 5, count=80)
    log = log.with_noisy_regressor(np.random.default_rng(seed), 0.03)
    prior = prior_of(log, seed)
    edges = [0, *sorted(set(cuts)), 80]
    parts = [log[a:b].observations() for a, b in pairwise(edges)]
    random.shuffle(parts)
    merged = parts[0]
    for part in parts[1:]:
        merged = merged.merge(part)
    whole = posterior(log.observations(), prior)
    covariance = whole.deviation_factor @ whole.deviation_factor.T
    assert_posterior(posterior(merged, prior), whole.mean, covariance, 1e-7)


@few
@given(seeds, st.booleans())
def test_units_of_parameters_and_forces_do_not_matter(seed, related):
    rng = np.random.default_rng(seed)
    log = gaussian_log(seed % 5).with_noisy_regressor(rng, 0.03)
    prior = prior_of(log, seed, related=related)
    unit, force = 10.0 ** rng.uniform(-3, 3, len(prior.std)), 10.0 ** rng.uniform(-3, 3)
    there = replace(
        log,
        K=force * log.K / unit,
        y=force * log.y,
        noise_rows=force * log.noise_rows / unit,
        noise_targets=force * log.noise_targets,
    )
    factor = None if prior.factor is None else unit[:, None] * prior.factor
    scaled = replace(prior, mean=prior.mean * unit, std=prior.std * unit, factor=factor)
    here = posterior(log.observations(), prior)
    found = posterior(there.observations(), scaled)
    covariance = here.deviation_factor @ here.deviation_factor.T
    assert_posterior(replace(found, mean=found.mean / unit, factor=found.factor * unit,
                             prior=prior), here.mean, covariance, 1e-6)  # fmt: skip
    assert found.prior_scale == pytest.approx(here.prior_scale, rel=1e-4)
    assert found.noise_share == pytest.approx(here.noise_share, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_gain_is_the_ratio_of_determinants(seed):
    log, prior, known = case(seed, related=True, weighed=True)
    found = posterior(log.observations(), prior, known)
    before, after = (
        factor @ factor.T for factor in (prior.covariance_factor(), found.deviation_factor)
    )
    unit = np.outer(prior.std, prior.std)
    for count in (1, 10, len(prior.std)):
        volumes = [np.linalg.slogdet((P / unit)[:count, :count])[1] for P in (before, after)]
        assert found.gain(count) == pytest.approx((volumes[0] - volumes[1]) / 2, rel=1e-8)


class Trials:
    """Many draws of noise and prior about one motion, each identified."""

    COUNT = 600

    def __init__(self, draws, *, regressor_noise=0.0, corrected=True):
        rng = np.random.default_rng(8)
        log = gaussian_log(8, count=self.COUNT)
        self.root = noise_root(rng, log.K.shape[1])
        prior = prior_of(log, 8)
        self.log, self.prior, self.found = log, prior, []
        for _ in range(draws):
            drawn = log.measured(rng, self.root)
            if regressor_noise:
                drawn = drawn.with_noisy_regressor(rng, regressor_noise)
            if not corrected:
                drawn = replace(drawn, noise_rows=np.zeros_like(drawn.K))
            belief = scattered(prior, log.truth, rng)
            self.found.append(posterior(drawn.observations(), belief))

    @property
    def normalised(self):
        """Errors (draws, p) in independent units of the posteriors' deviations."""
        return np.array(
            [
                np.linalg.solve(each.deviation_factor, each.mean - self.log.truth)
                for each in self.found
            ]
        )

    @property
    def per_direction(self):
        """Errors (draws, p) in the posteriors' eigen-directions against the prior, best first."""
        errors = []
        for each in self.found:
            whitened = each.factor * self.prior.std
            _, values, Vt = np.linalg.svd(whitened)
            errors.append(values * (Vt @ ((each.mean - self.log.truth) / self.prior.std)))
        return np.array(errors)


@pytest.fixture(scope="module")
def trials():
    return Trials(50)


def test_the_posterior_covariance_is_the_cramer_rao_bound(trials):
    """The Bayesian bound, Van Trees 2001, Detection, Estimation, and Modulation Theory I, 2.4."""
    weight = np.linalg.inv(trials.root @ trials.root.T)
    scaled = trials.log.K * trials.prior.std
    information = np.einsum("tia,ij,tjb->ab", scaled, weight, scaled, optimize=True)
    information += np.eye(len(information))
    for each in trials.found[:10]:
        precision = (each.factor * trials.prior.std).T @ (each.factor * trials.prior.std)
        # 2 sqrt(n / N) is how far the estimated covariance of noise strays by chance.
        chance = 2 * np.sqrt(len(weight) / trials.COUNT)
        ratios = eigh(precision, information, eigvals_only=True)
        assert ratios.min() > 1 - 1.3 * chance
        assert ratios.max() < 1 + 1.3 * chance


def test_errors_match_the_stated_deviations(trials):
    assert np.mean(trials.normalised**2) == pytest.approx(1, abs=0.1)
    squares = np.mean(trials.per_direction**2, axis=0)
    # Of fifty draws a mean square strays by sqrt(2 / 50) = .2.
    assert 0.3 < squares.min() < squares.max() < 2.0


def test_intervals_have_their_nominal_coverage(trials):
    hits = [np.abs(each.mean - trials.log.truth) < 1.645 * each.std for each in trials.found]
    assert np.mean(hits) == pytest.approx(0.9, abs=0.03)


def test_noise_in_the_regressor_biases_unless_it_is_subtracted():
    def bias(corrected):
        """Mean square of the errors' mean over draws, 1 where only chance is left."""
        trials = Trials(25, regressor_noise=0.1, corrected=corrected)
        mean = np.mean([each.mean - trials.log.truth for each in trials.found], axis=0)
        square = np.mean([np.mean((each.factor @ mean) ** 2) for each in trials.found])
        scale = np.median([each.prior_scale for each in trials.found])
        return len(trials.found) * square, np.mean(trials.normalised**2), scale

    (with_it, spread, scale), (without, wrong, too_wide) = bias(True), bias(False)
    # What is left is of second order in the noise.
    assert with_it < 2
    assert without > 30 * with_it
    assert spread < 1.5
    assert wrong > 3 * spread
    # The evidence does not take the noise's pull for a prior that is wrong.
    assert scale == pytest.approx(1, abs=0.15)
    assert abs(too_wide - 1) > 2 * abs(scale - 1)


@pytest.mark.parametrize("count", [2, 4])
def test_few_windows_do_not_give_false_certainty(count):
    """Residuals that the prior's freedom fits exactly must not shrink Σ to nothing."""
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        log = gaussian_log(seed % 4, count=count)
        belief = scattered(prior_of(log, seed), log.truth, rng)
        found = posterior(log.observations(), belief)
        error = (found.mean - log.truth) / belief.std
        squares.append(np.mean((found.factor * belief.std @ error) ** 2))
    assert np.median(squares) < 10


def test_one_direction_in_a_hundred_may_be_noise():
    """A joint that rests shows nothing but noise, which must not condemn a whole log."""
    shares = np.array([0.9, 0.3, 0.1])
    for count, expected in ((99, shares[0]), (100, shares[1])):
        # The rows' information is 99 times the prior's.
        noise = 100 * np.diag(np.pad(shares, (0, count - 3)))
        zero = np.zeros(count)
        square = quadratic_cost.QuadraticCost(
            99 * np.eye(count), zero, noise, zero, np.eye(1), None
        )
        assert square.noise_share(np.ones(count)) == pytest.approx(expected)
