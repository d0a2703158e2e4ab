"""What a Gaussian with all terms free tells about armatures that resemble the links' inertias."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm
from gaussian_logs import gaussian_log
from scipy.linalg import cholesky

from symbid_ros.estimation.group_moments import CoordinateMoments, CoordinateRows, GroupMoments
from symbid_ros.estimation.posterior import Posterior, posterior
from symbid_ros.estimation.prior import Prior, consistent_prior
from symbid_ros.estimation.term_evidence import CandidateTerms, _LeftOut, conditional
from symbid_ros.model.parameters import ParameterSet

ALIKE, ALONE = 1.0, 0.1  # deviations of single armatures, and of their mean


def evidence(armature, joints=8):
    """Return what tells joints' armatures (J,), known together far better than one by one."""
    parameters = ParameterSet(arm(links=joints + 1), ("armature",), candidates=True)
    p, terms = len(parameters), np.arange(joints) + parameters.term_columns["armature"].start
    covariance = np.eye(p)
    together = np.full((joints, joints), 1 / joints)
    covariance[np.ix_(terms, terms)] = ALIKE**2 * (np.eye(joints) - together)
    covariance[np.ix_(terms, terms)] += ALONE**2 * joints * together
    mean = np.zeros(p)
    mean[terms] = armature
    prior = Prior("arm", "test", None, parameters.names, np.zeros(p), np.full(p, 10.0))
    factor = np.linalg.cholesky(np.linalg.inv(covariance)).T
    found = Posterior(mean, factor, prior, np.eye(1), 1.0, 0.0)
    return CandidateTerms(found, parameters, terms)


@pytest.mark.parametrize(("value", "found"), [(0.5, True), (0.2, False), (-0.5, False)])
def test_equal_armatures_are_found_together(value, found):
    # None of them is half a deviation from zero; their mean is two or five.
    assert evidence(value).have_common_armature() == found


def test_armatures_of_few_joints_need_not_be_alike():
    assert not evidence(5.0, joints=3).have_common_armature()


@pytest.mark.parametrize("count", [9, 7])
def test_fixed_parameters_leave_the_gaussian_of_the_others(count):
    """Direct: the square of the remaining parameters, of which the fixed ones are constants."""
    rng = np.random.default_rng(0)
    R = cholesky((A := rng.normal(size=(20, 9))).T @ A)
    mean, before = rng.normal(size=(2, 9))
    prior = Prior("robot", "test", None, tuple("abcdefghi"), before, np.ones(9))
    found = Posterior(mean, R, prior, np.eye(1), 1.0, 0.0)
    unknowns = np.ones(count, bool)
    unknowns[[1, 2, 5]] = False
    is_free = np.append(unknowns, np.ones(9 - count, bool))
    free, fixed = np.flatnonzero(is_free), np.flatnonzero(~is_free)
    precision = R.T @ R
    direct = np.linalg.inv(precision[np.ix_(free, free)])
    pull = precision[np.ix_(free, fixed)] @ (before - mean)[fixed]
    some = np.array([4, 0, 8])
    value, covariance = conditional(found, unknowns, some)
    place = np.searchsorted(free, some)
    np.testing.assert_allclose(value, (mean[free] - direct @ pull)[place], rtol=1e-9)
    np.testing.assert_allclose(covariance, direct[np.ix_(place, place)], rtol=1e-9)


@pytest.mark.parametrize(("count", "kind"), [(60, CoordinateRows), (400, CoordinateMoments)])
def test_left_out_rows_are_predicted_from_all_others(count, kind):
    """Direct: solve again without a group's rows of the joint, and with some parameters fixed."""
    log = gaussian_log(6, links=4, count=count, terms=("viscous", "offset"))
    stamp = np.arange(count) * 200_000_000
    groups = GroupMoments.empty(log.layout, candidates=True).fold(
        [replace(log.rows(), stamp=stamp)]
    )
    found = posterior(log.observations(), consistent_prior(log.parameters))
    part = next(one for one in groups.complete if one.coordinate == len(log.layout.coordinates) - 2)
    assert isinstance(part, kind)
    p, joint = len(log.parameters), part.coordinate
    free = np.ones(p, bool)
    free[[2, 9, p - 1]] = False
    term = log.parameters.term_columns["viscous"].start
    kept = free & (np.arange(p) != term)
    rows, weight = log.rows().mean, 1 / found.covariance[joint, joint]
    K, y = rows.K[:, joint], rows.y[:, joint]
    precision, square = found.factor.T @ found.factor, 0.0
    target = precision @ found.mean
    for group in range(8):
        left = stamp // 1_000_000_000 % 8 == group
        rest = precision - weight * K[left].T @ K[left]
        pull = target - weight * K[left].T @ y[left]
        value = found.prior.mean.copy()
        value[kept] = np.linalg.solve(
            rest[np.ix_(kept, kept)], pull[kept] - rest[np.ix_(kept, ~kept)] @ value[~kept]
        )
        square += weight * np.sum((y[left] - K[left] @ value) ** 2)
    judged = _LeftOut(found, free, groups, part).without(term)
    assert judged == pytest.approx(square, rel=1e-6)


def test_moments_of_few_rows_are_not_stored():
    log = gaussian_log(6, links=4, count=60)
    layout = log.layout
    stamp = np.arange(60) * 200_000_000
    groups = GroupMoments.empty(layout, candidates=True).fold([replace(log.rows(), stamp=stamp)])
    rows = sum(one.size for part in groups.complete for one in part.rows)
    assert rows == 60 * sum(len(layout.columns[part.coordinate]) + 1 for part in groups.complete)
