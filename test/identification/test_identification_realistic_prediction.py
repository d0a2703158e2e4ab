"""Realistic predictions for simulated bags are compared with their ground truth."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from random_robots import CONFIG, random_robot
from tree_simulation import TreeSimulation

from symbid_ros.dynamics.contact import contact_jacobian, contact_wrenches
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.evaluation import predict
from symbid_ros.identification.predictions.realistic_prediction import (
    SINGULAR,
    evaluate_realistic,
    predict_realistic,
)
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
from symbid_ros.signals.filters import CausalLowPass
from symbid_ros.simulation.recording import record


@pytest.fixture(scope="module")
def ideal(simulated):
    return simulated("smooth", moves=1, motion_seed=22, ideal=True)


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"))


@pytest.fixture(scope="module")
def noisy(simulated, symbitron):
    bag = simulated("smooth", moves=1, motion_seed=21, noise_seed=5)
    return read_realistic_motion([bag], symbitron.model)


def test_eq_4_1_finds_the_measured_wrenches_of_an_ideal_bag(ideal, symbitron):
    samples = read_true_motion([ideal], symbitron.model).samples
    poses = link_poses(symbitron.model, samples.position)
    jacobian = contact_jacobian(symbitron.model, samples.wrench_frames, poses)
    force = equation_of_motion(symbitron, samples).K @ symbitron.values
    force[:, 6:] -= samples.effort
    # Feet that twist against each other hardly load the coordinates; the data do not determine it.
    found = contact_wrenches(jacobian, force, SINGULAR).reshape(-1, 12)
    left, size, felt = np.linalg.svd(jacobian.transpose(0, 2, 1), full_matrices=False)
    assert left.shape == (len(samples), 16, 12)
    determined = felt * (size > SINGULAR * size[:, :1])[..., None]
    seen = np.einsum("nki,nj,nkj->ni", determined, samples.wrenches.reshape(-1, 12), determined)
    np.testing.assert_allclose(found, seen, atol=1e-2)


@pytest.mark.parametrize(
    ("seed", "floating", "frames"), [(1, True, 1), (4, True, 2), (2, False, 2), (3, False, 0)]
)
def test_eq_4_1_holds_for_any_tree(seed, floating, frames, tmp_path):
    robot = random_robot(seed, links=6, floating=floating, wrench_frames=frames)
    (tmp_path / "robot.xml").write_text(mjcf_text(robot))
    parameters = ParameterSet(load_model(tmp_path / "robot.xml"))
    record(TreeSimulation(robot, 0.4, seed), tmp_path / "log")
    motion = read_realistic_motion([tmp_path / "log"], parameters.model, CausalLowPass(0))
    measured = replace(motion.measured, velocity=motion.truth.samples.velocity)
    measured = replace(measured, effort=motion.truth.samples.effort)
    exact = predict_realistic(parameters, parameters.values, replace(motion, measured=measured))
    scale = np.linalg.norm(measured.effort) + np.linalg.norm(measured.wrenches)
    np.testing.assert_allclose(exact.torque, measured.effort, atol=1e-8 * scale)
    np.testing.assert_allclose(exact.torque_from_wrenches, measured.effort, atol=1e-8 * scale)
    jacobian = contact_jacobian(
        parameters.model, measured.wrench_frames, link_poses(parameters.model, measured.position)
    )
    error = (exact.wrenches - measured.wrenches).reshape(len(measured), 1, -1) @ jacobian
    np.testing.assert_allclose(error, 0, atol=1e-8 * scale)


def test_a_controller_has_the_last_torques_and_delayed_velocities(ideal, symbitron):
    cutoff = 40.0
    motion = read_realistic_motion([ideal], symbitron.model, CausalLowPass(cutoff))
    measured, truth = motion.measured, motion.truth.samples
    np.testing.assert_array_equal(measured.stamp, truth.stamp)
    np.testing.assert_array_equal(measured.position, truth.position)
    np.testing.assert_array_equal(measured.acceleration, truth.acceleration)
    np.testing.assert_array_equal(measured.effort[1:], truth.effort[:-1])
    # The backward difference is half a period late, the filter 0.225 periods of its cutoff.
    late = 0.0005 + 0.225 / cutoff
    time = (truth.stamp - truth.stamp[0]) * 1e-9
    settled = slice(100, None)
    for found, true in (
        (measured.velocity, truth.velocity),
        (measured.base_angular_velocity, truth.base_angular_velocity),
    ):
        shift = late if found is measured.velocity else late - 0.0005
        expected = np.stack([np.interp(time - shift, time, column) for column in true.T], axis=1)
        unshifted = np.sqrt(np.mean((found - true)[settled] ** 2))
        assert np.sqrt(np.mean((found - expected)[settled] ** 2)) < 0.2 * unshifted


def test_torques_and_contact_forces_balance(noisy, symbitron):
    prediction = predict_realistic(symbitron, symbitron.values, noisy)
    measured = noisy.measured
    needed = equation_of_motion(symbitron, measured).K @ symbitron.values
    poses = link_poses(symbitron.model, measured.position)
    jacobian = contact_jacobian(symbitron.model, measured.wrench_frames, poses)
    given = np.c_[np.zeros((len(measured), 6)), measured.effort]
    for k in range(0, len(measured), 97):
        contact = np.linalg.lstsq(jacobian[k].T, needed[k] - given[k], rcond=SINGULAR)[0]
        np.testing.assert_allclose(prediction.wrenches[k].ravel(), contact, atol=1e-6)
        left = needed[k] - jacobian[k].T @ contact
        np.testing.assert_allclose(prediction.torque[k], left[6:], atol=1e-6)


def test_the_prior_predicts_worse_than_the_truth(noisy, symbitron):
    prior = draw_prior(symbitron, "percent", 25, 1).mean
    metrics = evaluate_realistic(
        symbitron, {"truth": symbitron.values, "prior": prior}, symbitron.values, noisy
    )
    truth, wrong = asdict(metrics["truth"]), asdict(metrics["prior"])
    assert all(truth[name] < wrong[name] for name in truth)
    # Passive joints have exactly zero torque; noise of the eight motors' torques is 0.1 Nm.
    assert 0.1 < truth["torque_rmse"] < 0.1 * np.sqrt(8)
    # Noise of 1 N along three axes of two plates, and the motors' noise in the prediction.
    assert np.sqrt(6) < truth["contact_force_rmse"] < 2 * np.sqrt(6)
    assert truth["com_position_rmse_mm"] < 0.01


def test_metrics_are_rms_norms(noisy, symbitron):
    prior = draw_prior(symbitron, "percent", 25, 2).mean
    metrics = evaluate_realistic(symbitron, {"it": prior}, symbitron.values, noisy)["it"]
    found = predict_realistic(symbitron, prior, noisy)
    true = predict(symbitron, symbitron.values, noisy.truth)

    def rmse(error):
        return pytest.approx(np.sqrt(np.mean(np.sum(error.reshape(len(error), -1) ** 2, axis=1))))

    effort, contact = noisy.truth.samples.effort, found.wrenches - noisy.measured.wrenches
    assert metrics.torque_rmse == rmse(found.torque - effort)
    assert metrics.torque_from_wrenches_rmse == rmse(found.torque_from_wrenches - effort)
    assert metrics.contact_force_rmse == rmse(contact[:, :, 3:])
    assert metrics.contact_moment_rmse == rmse(contact[:, :, :3])
    assert metrics.com_position_rmse_mm == rmse(1e3 * (found.com - true.com))
    assert metrics.com_momentum_rmse == rmse(found.momentum - true.momentum)
