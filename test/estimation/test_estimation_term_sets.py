"""Sets of joint terms, against regressions whose terms are known."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from drive_logs import arm

from symbid_ros.choices import TERMS
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.term_sets import ENTER, RARE, TermSets
from symbid_ros.model.parameters import ParameterSet

SPEED = 0.2  # rad/s, of Stribeck friction
NOISE = 0.02  # Nm


def drive(rng, largest, rows=300):
    """Return speeds of a drive and its columns: viscous, Coulomb, offset, Stribeck."""
    speed = rng.uniform(0.02, largest, rows) * rng.choice([-1, 1], rows)
    sign = np.sign(speed)
    return np.column_stack([speed, sign, np.ones(rows), sign * np.exp(-np.abs(speed) / SPEED)])


KINDS = ["viscous", "coulomb", "offset", "stribeck"]


def gaussian(parameters, joints):
    """Return a Gaussian over all parameters from rows (K, y) of each joint's four terms."""
    p = len(parameters)
    std = np.full(p, 10.0)
    precision, moment = np.diag(1 / std**2), np.zeros(p)
    for index, (K, y) in enumerate(joints):
        places = [parameters.term_columns[kind].start + index for kind in KINDS]
        precision[np.ix_(places, places)] += K.T @ K / NOISE**2
        moment[places] += K.T @ y / NOISE**2
    mean = np.linalg.solve(precision, moment)
    prior = Prior("arm", "test", None, parameters.names, np.zeros(p), std)
    factor = np.linalg.cholesky(precision).T
    return Posterior(mean, factor, prior, np.eye(1), 1.0, 0.0)


def places(parameters, joint):
    return np.array([parameters.term_columns[kind].start + joint for kind in KINDS])


def sets_of(parameters, found, terms, **sets):
    given = {"kept": set(), "fixed": set(), "before": set()} | sets
    return TermSets(found, parameters, np.sort(terms), **given)


@pytest.fixture(scope="module")
def parameters():
    return ParameterSet(arm(links=4), TERMS, candidates=True)


def test_intervals_cover_friction_of_slow_joints_although_the_terms_are_chosen(parameters):
    """At up to 0.1 rad/s, Stribeck friction resembles Coulomb less viscous friction."""
    truth = np.array([0.3, 1.0, 0.0, 0.0])
    within, without = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        joints = []
        for _ in range(3):
            K = drive(rng, 0.1)
            joints.append((K, K @ truth + NOISE * rng.normal(size=len(K))))
        found = gaussian(parameters, joints)
        terms = np.concatenate([places(parameters, joint) for joint in range(3)])
        sets = sets_of(parameters, found, terms)
        chosen = sets.best()
        N = sets.deviations(chosen)
        fixed = np.setdiff1d(terms, chosen)
        C = found.deviation_factor @ found.deviation_factor.T
        gain = np.linalg.solve(C[np.ix_(fixed, fixed)], C[fixed]).T
        mean = found.mean - gain @ found.mean[fixed]
        variance = (C - gain @ C[fixed]).diagonal()
        for joint in range(3):
            own = places(parameters, joint)
            for place, true in zip(own, truth, strict=True):
                if place in chosen:
                    error = abs(mean[place] - true)
                    without.append(error < 1.645 * np.sqrt(variance[place]))
                    total = variance[place] + np.sum(N[place] ** 2)
                    within.append(error < 1.645 * np.sqrt(total))
    assert np.mean(within) > 0.85
    assert np.mean(without) < np.mean(within)


def test_deviations_are_those_of_all_sets_by_their_probability(parameters):
    rng = np.random.default_rng(3)
    K = drive(rng, 0.3)
    y = K @ [0.02, 0.004, 0.003, 0.0] + NOISE * rng.normal(size=len(K))
    found = gaussian(parameters, [(K, y)])
    terms = places(parameters, 0)
    N = sets_of(parameters, found, terms).deviations(np.array([], dtype=int))
    # Dense algebra: condition on each set's fixed terms.
    C = found.deviation_factor @ found.deviation_factor.T
    weights, means, covariances = [], [], []
    for one in product([False, True], repeat=len(terms)):
        is_free = dict(zip(KINDS, one, strict=True))
        fixed = terms[~np.array(one)]
        S = np.linalg.inv(C[np.ix_(fixed, fixed)])
        mean = found.mean - C[:, fixed] @ S @ found.mean[fixed]
        impossible = [is_free[kind] and mean[terms[i]] < 0 for i, kind in enumerate(KINDS[:2])]
        if any(impossible) or (is_free["stribeck"] and not is_free["coulomb"]):
            continue
        square = found.mean[fixed] @ S @ found.mean[fixed]
        cost = ENTER * sum(one) + RARE * is_free["stribeck"]
        weights.append(np.exp(-0.5 * square - cost))
        means.append(mean)
        covariances.append(C - C[:, fixed] @ S @ C[fixed])
    weights = np.array(weights) / np.sum(weights)
    expected = sum(
        weight * (covariance - covariances[0] + np.outer(mean - means[0], mean - means[0]))
        for weight, mean, covariance in zip(weights, means, covariances, strict=True)
    )
    assert len(weights) > 3
    assert np.sort(weights)[-2] > 0.01
    own = np.ix_(terms, terms)
    np.testing.assert_allclose((N @ N.T)[own], expected[own], rtol=0.01, atol=1e-8)


def test_there_is_no_stribeck_without_coulomb_friction(parameters):
    """The data would have Coulomb less Stribeck friction, a rise of friction with speed."""
    rng = np.random.default_rng(0)
    for size in (0.02, 0.1, 0.5):
        K = drive(rng, 1.0)
        y = K @ [0.0, 0.0, 0.0, size] + NOISE * rng.normal(size=len(K))
        found = gaussian(parameters, [(K, y)])
        terms = places(parameters, 0)
        chosen = sets_of(parameters, found, terms).best()
        assert terms[3] not in chosen or terms[1] in chosen


def test_a_term_that_the_other_drives_have_needs_less_evidence(parameters):
    rng = np.random.default_rng(1)
    weak = drive(rng, 0.3)
    offset = 2.2 * NOISE / np.sqrt(len(weak))
    # Exactly 2.2 standard deviations of an offset.
    row = (weak, weak @ [0.0, 0.0, offset, 0.0])
    strong = (weak, weak @ [0.0, 0.0, 1.0, 0.0])
    terms = np.concatenate([places(parameters, joint) for joint in range(3)])
    own = places(parameters, 0)[2]
    alone = gaussian(parameters, [row, (weak, 0 * weak[:, 0]), (weak, 0 * weak[:, 0])])
    beside = gaussian(parameters, [row, strong, strong])
    assert own not in sets_of(parameters, alone, terms).best()
    assert own in sets_of(parameters, beside, terms).best()
    # A choice from fewer data stays.
    assert own in sets_of(parameters, beside, terms, before={own}).best()


def test_kept_and_fixed_terms_stay_as_they_are(parameters):
    rng = np.random.default_rng(2)
    K = drive(rng, 0.3)
    found = gaussian(parameters, [(K, K @ [0.0, 1.0, 0.0, 0.0])])
    terms = places(parameters, 0)
    sets = sets_of(parameters, found, terms, kept={terms[0]}, fixed={terms[1]})
    chosen = sets.best()
    assert terms[0] in chosen
    assert terms[1] not in chosen


def test_deviations_allow_for_a_term_that_the_log_does_not_show(parameters):
    """Its variance exceeds those of two terms that look alike by more than the digits of a number.

    In units in which the unseen term has unit variance, the covariance is that of any other log.
    """
    rng = np.random.default_rng(5)
    K = rng.standard_normal((60, 4))
    K[:, 2] = K[:, 1] + 1e-3 * K[:, 2]
    found = gaussian(parameters, [(K, K @ [0.3, 1.0, 0.2, 0.1])])
    unseen = places(parameters, 0)[3]
    unit = np.ones(len(parameters))
    unit[unseen] = 1e18
    prior = replace(found.prior, std=found.prior.std * unit)
    wide = replace(found, factor=found.factor / unit, prior=prior, mean=found.mean * unit)
    chosen = places(parameters, 0)[:2]
    plain, scaled = (
        sets_of(parameters, one, places(parameters, 0)).deviations(chosen) for one in (found, wide)
    )
    scaled = scaled / unit[:, None]
    scale = np.abs(plain @ plain.T).max()
    np.testing.assert_allclose(scaled @ scaled.T, plain @ plain.T, atol=1e-6 * scale)
