"""Evidence for a change against its likelihood ratios; discounted and relaxed priors."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log, noise_root, prior_of
from random_robots import random_robot
from scipy.stats import multivariate_normal

from symbid_ros.estimation.change import (
    LEARNED_WEIGHT,
    LEAST_WEIGHT,
    Innovation,
    LinkChange,
    discounted_prior,
    discounted_pseudo_measurements,
    innovation,
    prior_after_change,
    relaxed_prior,
)
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior
from symbid_ros.estimation.prior_std import PAYLOAD, link_extent, payload_std
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.signals.weak_form import INFLATION


def logs(seed, *, change=None):
    """Return an earlier log of a robot, a later one, and the prior; the change is the later's."""
    log = gaussian_log(seed, count=400)
    earlier, later = log[:250], log[250:]
    if change is not None:
        later = replace(later, y=later.y + later.K @ change)
    return earlier, later, prior_of(log, seed)


def payload(log, index, mass):
    """Return what a payload on one link adds to the parameters."""
    phi = np.zeros(len(log.parameters))
    inertia = mass * 1e-3 * np.eye(3)
    phi[10 * index : 10 * index + 10] = phi_from_com(mass, np.array([0.05, -0.1, 0.1]), inertia)
    return phi


@pytest.mark.parametrize("seed", range(3))
def test_evidence_is_the_ratio_of_likelihoods(seed) -> None:
    earlier, later, prior = logs(seed)
    later = later[:40]  # dense matrices are 9 times as wide
    known = posterior(earlier.observations(), prior)
    found = innovation(known, [later.rows()], earlier.parameters)
    # Dense: all rows of all coordinates, their covariance with and without one link's change.
    count, _, p = later.K.shape
    K, y = later.K.reshape(-1, p), later.y.ravel()
    noise = np.kron(np.eye(count), known.covariance)
    spread = K @ known.deviation_factor
    unchanged = noise + spread @ spread.T
    mean = K @ known.mean
    without = multivariate_normal.logpdf(y, mean, unchanged)
    total = earlier.parameters.link_phi(prior.mean)[:, 0].sum()
    for change in found.changes:
        index = earlier.parameters.link_names.index(change.link)
        extent = max(link_extent(earlier.parameters.link_phi(prior.mean)[index]), 0.05)
        scale = PAYLOAD * total * np.repeat([1, extent, extent**2], [1, 3, 6])
        moved = K[:, 10 * index : 10 * index + 10] * scale
        with_change = multivariate_normal.logpdf(y, mean, unchanged + moved @ moved.T)
        assert change.evidence == pytest.approx(with_change - without, rel=1e-6, abs=1e-6)


def test_no_change_is_found_without_a_change() -> None:
    misfits, evidence = [], []
    for seed in range(12):
        earlier, later, prior = logs(seed)
        # The truth is the prior's draw away from its mean, as the posterior has it.
        found = innovation(
            posterior(earlier.observations(), prior), [later.rows()], earlier.parameters
        )
        misfits.append(found.misfit)
        evidence.append(found.changes[0].evidence)
    assert np.mean(misfits) == pytest.approx(1.0, abs=0.15)
    assert max(evidence) < 5.0


def test_noise_of_overlapping_windows_is_expected() -> None:
    """Half-overlapped Hann windows share a sixth of their noise's variance with each neighbour."""
    count, neighbours = 400, np.eye(400, k=1) + np.eye(400, k=-1)
    overlap = np.linalg.cholesky(np.eye(count) + neighbours / 6)
    misfits = []
    for seed in range(30):
        log, rng = gaussian_log(seed, count=count), np.random.default_rng(seed)
        n = log.y.shape[1]
        noise = overlap @ rng.normal(size=(count, n)) @ noise_root(rng, n).T
        log = replace(log, y=log.K @ log.truth + noise, inflation=INFLATION)
        known = posterior(log[:250].observations(), prior_of(log, seed))
        misfits.append(innovation(known, [log[250:].rows()], log.parameters).misfit)
    # The deviation of this mean is 0.06. Applied twice, the factor 4/3 gives 1.29.
    assert np.mean(misfits) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("index", [0, 1, 2])
def test_the_changed_link_is_named_with_its_mass(seed, index) -> None:
    plain, _, _ = logs(seed)
    added = payload(plain, index, 0.05 * plain.parameters.link_phi(plain.truth)[:, 0].sum())
    earlier, later, prior = logs(seed, change=added)
    found = innovation(posterior(earlier.observations(), prior), [later.rows()], earlier.parameters)
    suspect = found.changes[0]
    assert suspect.link == earlier.parameters.link_names[index]
    assert suspect.evidence > 30.0
    error = (suspect.phi - added[10 * index : 10 * index + 10]) / suspect.std
    assert np.sqrt(np.mean(error**2)) < 3.0


HINGES = [
    (seed, index)
    for seed in range(4)
    for index in (1, 2)
    if random_robot(seed, 3).joints[index - 1].kind == "revolute"
]


@pytest.mark.parametrize(("seed", "index"), HINGES)
def test_a_mass_on_a_hinges_axis_is_not_attributed_to_one_link(seed, index) -> None:
    """A point on a hinge's axis moves alike with parent and child: no motion tells them apart."""
    plain, _, _ = logs(seed)
    parameters = plain.parameters
    joint = parameters.model.joints[index - 1]
    mass = 0.05 * parameters.link_phi(plain.truth)[:, 0].sum()
    added = np.zeros(len(parameters))
    added[10 * index] = mass
    earlier, later, prior = logs(seed, change=added)
    found = innovation(
        posterior(earlier.observations(), prior), [later.rows()], parameters
    ).suspects()
    assert {one.link for one in found} == {
        parameters.link_names[joint.parent],
        parameters.link_names[index],
    }
    for change in found:
        on_parent = change.link == parameters.link_names[joint.parent]
        place = joint.translation if on_parent else np.zeros(3)
        np.testing.assert_array_less(np.abs(change.phi[0] - mass), 4 * change.std[0])
        np.testing.assert_array_less(np.abs(change.phi[1:4] - mass * place), 4 * change.std[1:4])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("index", [0, 1, 2])
def test_a_mass_off_every_axis_is_attributed_to_its_link(seed, index) -> None:
    plain, _, _ = logs(seed)
    mass = 0.2 * plain.parameters.link_phi(plain.truth)[:, 0].sum()
    earlier, later, prior = logs(seed, change=payload(plain, index, mass))
    known = posterior(earlier.observations(), prior)
    (suspect,) = innovation(known, [later.rows()], earlier.parameters).suspects()
    assert suspect.link == earlier.parameters.link_names[index]


@pytest.mark.parametrize("related", [False, True])
def test_a_relaxed_prior_adds_the_payloads_variance(related) -> None:
    log = gaussian_log(3)
    prior = prior_of(log, 3, related=related)
    usual = payload_std(log.parameters, prior.mean)[1]
    phi = 0.1 * usual
    phi[2] = -3.0 * usual[2]  # a payload farther away than usual
    change = LinkChange(log.parameters.link_names[1], 99.0, 99.0, phi, 0.1 * usual)
    found = relaxed_prior(prior, log.parameters, change)
    before, after = (p.covariance_factor() @ p.covariance_factor().T for p in (prior, found))
    added = np.zeros(len(prior.mean))
    added[10:20] = usual**2
    added[12] *= 9.0
    scale = np.outer(found.std, found.std)
    np.testing.assert_allclose((after - before) / scale, np.diag(added) / scale, atol=1e-12)
    np.testing.assert_array_equal(found.mean, prior.mean)
    np.testing.assert_allclose(found.std**2, np.diag(after), rtol=1e-12)


@pytest.mark.parametrize("kept", [1.0, 0.5, 1e-3])
def test_a_discounted_prior_equals_rows_of_less_weight(kept) -> None:
    log = gaussian_log(5)
    prior = prior_of(log, 5, related=True)
    weight = max(kept, LEAST_WEIGHT)
    faded = discounted_prior(prior, kept)
    precision, expected = (
        np.linalg.inv(p.covariance_factor() @ p.covariance_factor().T * scale)
        for p, scale in ((faded, 1.0), (prior, 1 / weight))
    )
    np.testing.assert_allclose(precision, expected, rtol=1e-8)
    known = PseudoMeasurements(np.eye(len(prior.mean))[:2], np.ones(2))
    rows = discounted_pseudo_measurements(known, kept)
    np.testing.assert_allclose(rows.rows.T @ rows.rows, weight * known.rows.T @ known.rows)
    assert discounted_pseudo_measurements(None, kept) is None


def test_discounting_observations_changes_only_their_weight() -> None:
    log = gaussian_log(7, count=400)
    whole, faded = log.observations(), log.observations().discounted(0.25)
    assert faded.rows.samples == 0.25 * whole.rows.samples
    assert faded.kept == 0.25
    phi = log.truth
    # One row's residual is what it was; all of them together tell a quarter.
    moment = [one.rows.residual_moment(phi) / one.rows.samples for one in (whole, faded)]
    np.testing.assert_allclose(*moment, rtol=1e-9)
    prior = prior_of(log, 7)
    known = [posterior(one, discounted_prior(prior, 1.0)) for one in (whole, faded)]
    assert np.all(known[0].std <= known[1].std * (1 + 1e-6))
    assert np.all(known[1].std <= 2.1 * known[0].std)


@pytest.mark.parametrize("usual", [1.0, 2.5])
def test_links_that_fit_within_ten_nats_are_suspects(usual) -> None:
    """Log-likelihoods are too large by the usual misfit; the fit counts, not the evidence."""
    fits = (30.0, 30.0 - 9.9 * usual, 30.0 - 10.1 * usual, 40.0)
    links = tuple(
        LinkChange(str(i), 50.0 - i, fit, np.zeros(10), np.ones(10)) for i, fit in enumerate(fits)
    )
    found = Innovation(misfit=usual, changes=links).suspects(usual)
    assert [link.link for link in found] == ["0", "1", "3"]


def test_after_a_change_the_data_before_it_have_a_quarter_of_their_weight() -> None:
    """The other links would have this posterior if the data were given that weight."""
    earlier, _, prior = logs(1)
    parameters = earlier.parameters
    known = posterior(earlier.observations(), prior)
    usual = payload_std(parameters, known.mean)[1]
    change = LinkChange(parameters.link_names[1], 99.0, 99.0, 0.1 * usual, 0.1 * usual)
    found = prior_after_change(known, prior, parameters, [change])
    np.testing.assert_allclose(found.mean, known.mean)
    count = parameters.inertial
    stated, after = (
        one.covariance_factor()[:count] @ one.covariance_factor()[:count].T
        for one in (known.prior, found)
    )
    before = known.deviation_factor[:count] @ known.deviation_factor[:count].T
    told = np.linalg.inv(before) - np.linalg.inv(stated)
    expected = np.linalg.inv(np.linalg.inv(stated) + LEARNED_WEIGHT * told)
    expected[range(10, 20), range(10, 20)] += usual**2
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(after / scale, expected / scale, atol=1e-6)
    # Nothing is known worse than before all data.
    others = np.delete(np.arange(count), range(10, 20))
    assert np.all(found.std[others] <= known.prior.std[others] * (1 + 1e-9))
