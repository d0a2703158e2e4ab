"""The base's motion from an IMU on any link, against MuJoCo's velocities and accelerations."""

import mujoco
import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import centroidal, com_position, momentum_regressor
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.parameters import ParameterSet


class RandomState:
    """One random state of a random robot in MuJoCo, with random accelerations."""

    def __init__(self, seed, links=7):
        rng = np.random.default_rng(seed)
        self.model = random_robot(seed, links)
        self.m = m = mujoco.MjModel.from_xml_string(mjcf_text(self.model))
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self.d = d = mujoco.MjData(m)
        quaternion = rng.normal(size=4)
        d.qpos[:] = np.r_[rng.normal(size=3), quaternion, rng.uniform(-1, 1, m.nv - 6)]
        d.qpos[3:7] /= np.linalg.norm(quaternion)
        d.qvel[:] = rng.normal(size=m.nv) * 2
        d.qfrc_applied[:] = rng.normal(size=m.nv) * 5
        mujoco.mj_forward(m, d)
        mujoco.mj_rnePostConstraint(m, d)
        self.rotation = d.body(self.model.links[0].name).xmat.reshape(3, 3)

    def motion(self, kind, name):
        velocity, acceleration = np.empty(6), np.empty(6)
        index = mujoco.mj_name2id(self.m, kind, name)
        mujoco.mj_objectVelocity(self.m, self.d, kind, index, velocity, 1)
        mujoco.mj_objectAcceleration(self.m, self.d, kind, index, acceleration, 1)
        return velocity, acceleration

    def samples(self):
        d, one = self.d, np.zeros(1, dtype=np.int64)
        return Samples(
            stamp=one,
            position=d.qpos[None, 7:],
            velocity=d.qvel[None, 6:],
            acceleration=d.qacc[None, 6:],
            effort=np.zeros((1, self.m.nv - 6)),
            base_angular_velocity=d.qvel[None, 3:6],
            base_angular_acceleration=d.qacc[None, 3:6],
            base_specific_force=(self.rotation.T @ (d.qacc[:3] - self.m.opt.gravity))[None],
            wrenches=np.zeros((1, 0, 6)),
            wrench_frames=(),
        )


@pytest.mark.parametrize("seed", range(12))
def test_an_imu_on_any_link_gives_the_bases_motion(seed):
    state = RandomState(seed)
    velocity, acceleration = state.motion(mujoco.mjtObj.mjOBJ_SITE, "imu_link")
    imu = BaseMotion(velocity[None, :3], acceleration[None, :3], acceleration[None, 3:])
    truth = state.samples()
    joints = (truth.position, truth.velocity, truth.acceleration)
    base = base_motion(state.model, "imu_link", joints, imu)
    np.testing.assert_allclose(base.angular_velocity, truth.base_angular_velocity, atol=1e-11)
    scale = 1 + np.abs(truth.acceleration).max()
    np.testing.assert_allclose(
        base.angular_acceleration, truth.base_angular_acceleration, atol=1e-11 * scale
    )
    np.testing.assert_allclose(base.specific_force, truth.base_specific_force, atol=1e-11 * scale)


@pytest.mark.parametrize("seed", range(5))
def test_centroidal_quantities_are_mujocos(seed):
    state = RandomState(seed)
    d, rotation = state.d, state.rotation
    parameters, samples = ParameterSet(state.model), state.samples()
    poses = link_poses(state.model, samples.position)
    com = com_position(parameters, parameters.values, poses)[0]
    np.testing.assert_allclose(d.qpos[:3] + rotation @ com, d.subtree_com[1], atol=1e-13)
    velocity = (rotation.T @ d.qvel[:3])[None]
    about_base = momentum_regressor(parameters, samples, velocity, poses) @ parameters.values
    momentum = centroidal(about_base, com[None])[0]
    mujoco.mj_subtreeVel(state.m, d)
    mass = state.m.body_subtreemass[1]
    np.testing.assert_allclose(rotation @ momentum[3:], mass * d.subtree_linvel[1], atol=1e-12)
    np.testing.assert_allclose(rotation @ momentum[:3], d.subtree_angmom[1], atol=1e-12)
