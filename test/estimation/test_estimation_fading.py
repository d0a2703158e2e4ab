"""What is known beforehand, once old data are forgotten or a link has changed."""

import numpy as np
import pytest
from gaussian_logs import gaussian_log, prior_of

from symbid_ros.estimation.change import (
    LEAST_WEIGHT,
    discounted_prior,
    discounted_pseudo_measurements,
    relaxed_prior,
)
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior
from symbid_ros.estimation.prior_std import payload_std


@pytest.mark.parametrize("related", [False, True])
def test_a_released_link_has_the_payloads_variance_added(related) -> None:
    log = gaussian_log(3)
    prior = prior_of(log, 3, related=related)
    found = relaxed_prior(prior, log.parameters, log.parameters.link_names[1])
    before, after = (p.covariance_factor() @ p.covariance_factor().T for p in (prior, found))
    added = np.zeros(len(prior.mean))
    added[10:20] = payload_std(log.parameters, prior.mean)[1] ** 2
    scale = np.outer(found.std, found.std)
    np.testing.assert_allclose((after - before) / scale, np.diag(added) / scale, atol=1e-12)
    np.testing.assert_array_equal(found.mean, prior.mean)
    np.testing.assert_allclose(found.std**2, np.diag(after), rtol=1e-12)


@pytest.mark.parametrize("kept", [1.0, 0.5, 1e-3])
def test_a_prior_fades_as_rows_that_are_worth_less_would(kept) -> None:
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


def test_faded_observations_are_worth_less_and_nothing_else_changes() -> None:
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
