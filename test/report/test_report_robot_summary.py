"""Mass and centre of mass, and what the parameters' covariance says about them."""

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import com_position
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.robot_summary import summarise_robot


def com_of(parameters, values, posture):
    poses = link_poses(parameters.model, posture[None])
    return com_position(parameters, values, poses)[0]


@pytest.fixture(scope="module")
def robot():
    rng = np.random.default_rng(2)
    parameters = ParameterSet(random_robot(4, links=5))
    posture = rng.uniform(-1, 1, len(parameters.model.joints))
    factor = 1e-4 * rng.normal(size=(len(parameters), 7))
    return parameters, posture, factor


def test_mass_and_centre_of_mass_are_those_of_the_robot(robot):
    parameters, posture, factor = robot
    value, prior = parameters.values, 1.1 * parameters.values
    found = summarise_robot(parameters, value, prior, factor, posture)
    masses = value[: parameters.inertial : 10]
    assert found.mass == pytest.approx(masses.sum())
    assert found.mass_before == pytest.approx(1.1 * masses.sum())
    np.testing.assert_allclose(found.com, com_of(parameters, value, posture), atol=1e-12)
    np.testing.assert_allclose(found.com_before, found.com, atol=1e-12)
    assert found.is_mean_posture


def test_a_mass_is_measured_if_the_data_halve_its_variance(robot):
    parameters, posture, factor = robot
    value = parameters.values
    std = np.linalg.norm(factor[: parameters.inertial : 10].sum(axis=0))
    masses = parameters.inertial // 10
    for ratio, expected in ((1.5, True), (1.3, False)):
        prior_std = np.full(len(parameters), ratio * std / np.sqrt(masses))
        found = summarise_robot(parameters, value, value, factor, posture, prior_std=prior_std)
        assert found.is_mass_measured is expected
    assert summarise_robot(parameters, value, value, factor, posture).is_mass_measured is None


def test_a_mass_that_moved_beyond_its_prior_is_not_the_model_files(robot):
    parameters, posture, factor = robot
    prior_std = np.full(len(parameters), 0.1)
    spread = 0.1 * np.sqrt(parameters.inertial // 10)
    total = parameters.values[: parameters.inertial : 10].sum()
    for change, expected in ((1.1 * spread, True), (0.9 * spread, False)):
        value = (1 + change / total) * parameters.values
        found = summarise_robot(
            parameters, value, parameters.values, factor, posture, prior_std=prior_std
        )
        assert found.has_mass_moved is expected


def test_deviations_are_those_of_small_changes(robot):
    parameters, posture, factor = robot
    value = parameters.values
    found = summarise_robot(parameters, value, value, factor, posture)
    masses = factor[: parameters.inertial : 10].sum(axis=0)
    assert found.mass_std == pytest.approx(np.linalg.norm(masses))
    step = 1e-3
    changes = [
        (
            com_of(parameters, value + step * column, posture)
            - com_of(parameters, value - step * column, posture)
        )
        / (2 * step)
        for column in factor.T
    ]
    np.testing.assert_allclose(found.com_std, np.linalg.norm(changes, axis=0), rtol=1e-5)
    name, index = parameters.link_names[2], 20

    def own(values):
        return values[index + 1 : index + 4] / values[index]

    changes = [
        (own(value + step * column) - own(value - step * column)) / (2 * step)
        for column in factor.T
    ]
    expected = np.sqrt(np.mean(np.sum(np.square(changes), axis=0)))
    assert found.link_com_std[name] == pytest.approx(expected, rel=1e-5)


def test_without_covariance_and_posture_there_is_no_deviation(robot):
    parameters, _, _ = robot
    found = summarise_robot(parameters, parameters.values, parameters.values, None, None)
    assert np.isnan(found.mass_std)
    assert np.all(np.isnan(found.com_std))
    assert not found.is_mean_posture
    np.testing.assert_array_equal(found.posture, 0.0)


def test_the_base_of_a_fixed_robot_does_not_count():
    from documented_robots import ur5_urdf

    from symbid_ros.model.load import load_model

    parameters = ParameterSet(load_model(ur5_urdf()))
    value = parameters.values
    found = summarise_robot(parameters, value, value, None, None)
    assert not found.is_floating
    assert found.mass == pytest.approx(value[10 : parameters.inertial : 10].sum())
