"""Credible intervals of predictions against draws from the posterior."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from random_robots import random_robot, random_samples

import symbid_ros as sy
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import com_position, equation_of_motion
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.evaluation import TrueMotion, predict
from symbid_ros.identification.predictions.intervals import prediction_std, summarise_intervals
from symbid_ros.model.parameters import ParameterSet


def random_motion(parameters, count, rng):
    """Return a motion whose forces follow exactly from the true parameters."""
    model = parameters.model
    samples = random_samples(model, count, rng)
    rows = equation_of_motion(parameters, samples)
    first_joint = 6 * model.floating
    owed = (rows.K @ parameters.values - rows.y)[:, first_joint:]
    samples = replace(samples, effort=samples.effort + owed)
    return TrueMotion(samples, rng.normal(size=(count, 3)), np.tile(np.eye(3), (count, 1, 1)))


def random_factor(parameters, rng, size=0.02):
    """Return a square root of a correlated covariance, about ``size`` of each link's parameters."""
    scale = size * np.abs(parameters.link_phi(parameters.values)).max(axis=1).repeat(10)
    return scale[:, None] * rng.normal(size=(len(scale), len(scale))) / np.sqrt(len(scale))


@pytest.mark.parametrize(("seed", "floating"), [(0, True), (3, True), (2, False)])
def test_standard_deviations_equal_those_of_posterior_draws(seed, floating):
    rng = np.random.default_rng(seed)
    parameters = ParameterSet(random_robot(seed, links=4, floating=floating))
    motion = random_motion(parameters, 4, rng)
    factor = random_factor(parameters, rng)
    std = prediction_std(parameters, parameters.values, factor, motion)
    draws = parameters.values + rng.normal(size=(4000, len(parameters))) @ factor.T
    poses = link_poses(parameters.model, motion.samples.position)
    com = np.std([com_position(parameters, phi, poses) for phi in draws], axis=0)
    K = equation_of_motion(parameters, motion.samples).K
    force = np.std([K @ phi for phi in draws], axis=0)
    # 4000 draws determine a standard deviation to 1.1 %; five times that for the worst entry.
    np.testing.assert_allclose(std.com, com, rtol=0.055)
    np.testing.assert_allclose(std.torque, force[:, 6 * floating :], rtol=0.055)


def test_com_deviation_equals_the_first_order_change():
    rng = np.random.default_rng(7)
    parameters = ParameterSet(random_robot(7, links=5))
    motion = random_motion(parameters, 6, rng)
    for column in range(0, len(parameters), 3):
        step = np.zeros((len(parameters), 1))
        step[column] = 1e-6
        std = prediction_std(parameters, parameters.values, step, motion)
        ahead, behind = (
            predict(parameters, parameters.values + sign * step[:, 0], motion).com
            for sign in (1, -1)
        )
        np.testing.assert_allclose(std.com, np.abs(ahead - behind) / 2, rtol=1e-4, atol=1e-14)


@pytest.mark.parametrize("floating", [True, False])
def test_intervals_contain_the_truth_in_90_percent(floating):
    rng = np.random.default_rng(11)
    parameters = ParameterSet(random_robot(1, links=5, floating=floating))
    motion = random_motion(parameters, 20, rng)
    factor = random_factor(parameters, rng)
    summaries = [
        summarise_intervals(
            parameters,
            parameters.values + factor @ rng.normal(size=len(parameters)),
            factor,
            parameters.values,
            motion,
        )
        for _ in range(400)
    ]
    # Entries share a draw, so count draws: sqrt(.9 × .1 / 400) is 1.5 %.
    assert np.mean([s.com_coverage for s in summaries]) == pytest.approx(0.9, abs=0.04)
    assert np.mean([s.torque_coverage for s in summaries]) == pytest.approx(0.9, abs=0.04)


def test_summary_has_the_norms_of_the_deviations_in_millimetres_and_newton_metres():
    rng = np.random.default_rng(5)
    parameters = ParameterSet(random_robot(5, links=4))
    motion = random_motion(parameters, 8, rng)
    factor = random_factor(parameters, rng)
    std = prediction_std(parameters, parameters.values, factor, motion)
    far = parameters.values + 100 * factor.sum(axis=1)
    summary = summarise_intervals(parameters, parameters.values, factor, parameters.values, motion)
    assert summary.com_std_mm == pytest.approx(
        1e3 * np.sqrt(np.mean(np.linalg.norm(std.com, axis=1) ** 2))
    )
    assert summary.torque_std == pytest.approx(
        np.sqrt(np.mean(np.linalg.norm(std.torque, axis=1) ** 2))
    )
    assert (summary.com_coverage, summary.torque_coverage) == (1.0, 1.0)
    missed = summarise_intervals(parameters, far, factor, parameters.values, motion)
    assert missed.torque_coverage < 0.1


def test_total_mass_and_shared_displacement_need_no_pose():
    """A common factor on all of φ does not move the centre of mass."""
    rng = np.random.default_rng(3)
    parameters = ParameterSet(random_robot(3, links=6))
    motion = random_motion(parameters, 5, rng)
    scaled = 0.1 * parameters.values[:, None]
    std = prediction_std(parameters, parameters.values, scaled, motion)
    np.testing.assert_allclose(std.com, 0, atol=1e-15)
    K = equation_of_motion(parameters, motion.samples).K[:, 6:]
    np.testing.assert_allclose(std.torque, np.abs(0.1 * K @ parameters.values), rtol=1e-12)


def test_a_factor_of_another_robot_is_refused():
    rng = np.random.default_rng(2)
    parameters = ParameterSet(random_robot(2, links=3))
    motion = random_motion(parameters, 2, rng)
    for factor in (np.eye(20), np.ones(30)):
        with pytest.raises(EstimateError, match="30 parameters"):
            prediction_std(parameters, parameters.values, factor, motion)


def test_a_file_that_was_identified_is_not_trusted_where_logs_show_nothing():
    """The second log agrees with the file in all that it shows; others may be wrong as before."""
    robot = arm(seed=1, links=6)
    parameters, truth = ParameterSet(robot), drives(robot)
    file = parameters.apply(draw_prior(parameters, "consistent", 25, 1).mean)
    options = {"unchecked": True, "no_holdout": True}
    first = sy.identify(file, log_of(robot, truth, seed=1), **options)
    again = sy.identify(first.robot, log_of(robot, truth, seed=2), **options)
    assert again.estimate.verdict.prior_scale < 0.05
    for found in (first, again):
        errors = [
            (found.parameters[name].value - true) / found.parameters[name].std
            for name, true in zip(parameters.names, parameters.values, strict=True)
        ]
        assert np.sqrt(np.mean(np.square(errors))) < 2.0
