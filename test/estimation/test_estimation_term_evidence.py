"""What a Gaussian with all terms free tells about armatures that resemble the links' inertias."""

import numpy as np
import pytest
from drive_logs import arm
from scipy.linalg import cholesky

from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.term_evidence import CandidateTerms, conditional
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
