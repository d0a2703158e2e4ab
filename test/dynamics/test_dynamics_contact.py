"""Contact Jacobian and Eq. 4.1 against MuJoCo's site Jacobians and sample-wise least squares."""

import mujoco
import numpy as np
import pytest
from random_robots import CONFIG, random_robot, random_samples

from symbid_ros.dynamics.contact import contact_jacobian, contact_wrenches
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

COUNT = 6


def mujoco_jacobian(model, frames, position, rng):
    """Return MuJoCo's Jacobians (N, 6 F, n) of sites, in our rows and coordinates."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(model))
    data = mujoco.MjData(compiled)
    jacobians = []
    for q in position:
        base = np.eye(3)
        if model.floating:
            quaternion = rng.normal(size=4)
            data.qpos[3:7] = quaternion / np.linalg.norm(quaternion)
            mujoco.mju_quat2Mat(flat := np.empty(9), data.qpos[3:7])
            base = flat.reshape(3, 3)
        data.qpos[data.qpos.size - len(q) :] = q
        mujoco.mj_kinematics(compiled, data)
        mujoco.mj_comPos(compiled, data)
        rows = []
        for name in frames:
            linear, angular = np.empty((2, 3, compiled.nv))
            mujoco.mj_jacSite(compiled, data, linear, angular, compiled.site(name).id)
            axes = data.site(name).xmat.reshape(3, 3)
            rows += [axes.T @ angular, axes.T @ linear]
        jacobian = np.concatenate(rows)
        if model.floating:
            # MuJoCo: linear velocity first and in the world's axes; ours: angular first, base axes.
            jacobian[:, :6] = np.c_[jacobian[:, 3:6], jacobian[:, :3] @ base]
        jacobians.append(jacobian)
    return np.array(jacobians)


def jacobian_of(model, frames, position):
    return contact_jacobian(model, frames, link_poses(model, position))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("floating", [True, False])
def test_jacobian_is_mujocos(seed, floating):
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=3 + seed, floating=floating, wrench_frames=1 + seed % 3)
    samples = random_samples(model, COUNT, rng)
    ours = jacobian_of(model, samples.wrench_frames, samples.position)
    theirs = mujoco_jacobian(model, samples.wrench_frames, samples.position, rng)
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_symbitrons_jacobian_is_mujocos():
    rng = np.random.default_rng(5)
    model = load_model(CONFIG / "symbitron.xml")
    soles = ("left_sole", "right_sole")
    position = rng.uniform(-0.5, 0.5, (COUNT, 10))
    theirs = mujoco_jacobian(model, soles, position, rng)
    np.testing.assert_allclose(jacobian_of(model, soles, position), theirs, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("frames", range(4))
@pytest.mark.parametrize("floating", [True, False])
def test_wrenches_are_the_least_squares_solution_of_least_norm(seed, frames, floating):
    """Random frames give zero, full and deficient ranks."""
    rng = np.random.default_rng(seed)
    model = random_robot(seed, floating=floating, wrench_frames=frames)
    samples = random_samples(model, COUNT, rng)
    jacobian = jacobian_of(model, samples.wrench_frames, samples.position)
    force = rng.normal(size=(COUNT, 2, model.dof)) * 50
    found = contact_wrenches(jacobian, force)
    assert found.shape == (COUNT, 2, frames, 6)
    for J, sides, wrenches in zip(jacobian, force, found, strict=True):
        expected = np.linalg.lstsq(J.T, sides.T, rcond=1e-10)[0].T
        np.testing.assert_allclose(wrenches.reshape(2, -1), expected, rtol=1e-7, atol=1e-7)


def test_the_wrenches_of_two_feet_are_recovered():
    rng = np.random.default_rng(6)
    model = load_model(CONFIG / "symbitron.xml")
    samples = random_samples(model, 50, rng, ("left_sole", "right_sole"))
    done = equation_of_motion(ParameterSet(model), samples).y
    done[:, 6:] -= samples.effort
    jacobian = jacobian_of(model, samples.wrench_frames, samples.position)
    np.testing.assert_allclose(contact_wrenches(jacobian, done), samples.wrenches, atol=1e-6)


def test_opposite_moments_of_feet_on_parallel_legs_load_no_joint():
    model = load_model(CONFIG / "symbitron.xml")
    jacobian = jacobian_of(model, ("left_sole", "right_sole"), np.zeros((1, 10)))
    twist = np.zeros((1, 2, 6))
    twist[0, :, 2] = 1.0, -1.0
    felt = twist.reshape(1, 1, 12) @ jacobian
    np.testing.assert_allclose(felt, 0, atol=1e-12)
    assert np.linalg.matrix_rank(jacobian[0], tol=1e-9) == 11
    rest = contact_wrenches(jacobian, np.random.default_rng(7).normal(size=(1, 16)))
    assert np.sum(twist * rest) == pytest.approx(0, abs=1e-9)
