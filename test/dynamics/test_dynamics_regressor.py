"""K φ against MuJoCo's inverse dynamics and Pinocchio's regressor."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from random_robots import CONFIG, random_robot, random_samples, with_drives

from symbid_ros.choices import SIMULATED_TERMS, TERMS
from symbid_ros.dynamics.friction import is_slipping
from symbid_ros.dynamics.kinematics import CACHE_BLOCK
from symbid_ros.dynamics.regressor import equation_of_motion, equation_residual
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload

# Random motions are too fast for the two terms of simulated joints.
REAL_TERMS = tuple(term for term in TERMS if term not in SIMULATED_TERMS)
ROBOTS = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"
REAL = {
    "panda": (ROBOTS / "panda_description/urdf/panda.urdf", "fixed"),
    "anymal": (ROBOTS / "anymal_c_simple_description/urdf/anymal.urdf", "floating"),
    "talos": (ROBOTS / "talos_data/robots/talos_full_v2.urdf", "floating"),
    "g1": (ROBOTS / "g1_description/urdf/g1_29dof_rev_1_0.urdf", "floating"),
}


def relative_rmse(value, truth):
    return np.sqrt(np.mean((value - truth) ** 2) / np.mean(truth**2))


def mujoco_inverse(model, samples, rng):
    """Return MuJoCo's inverse dynamics with wrenches applied, in our coordinates."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(model))
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(compiled)
    rows = []
    for k in range(len(samples)):
        rotation = np.eye(3)
        if model.floating:
            quaternion = rng.normal(size=4)
            data.qpos[:3], data.qpos[3:7] = (
                rng.normal(size=3),
                quaternion / np.linalg.norm(quaternion),
            )
            flat = np.empty(9)
            mujoco.mju_quat2Mat(flat, data.qpos[3:7])
            rotation = flat.reshape(3, 3)
            data.qvel[:3], data.qvel[3:6] = rng.normal(size=3), samples.base_angular_velocity[k]
            data.qacc[:3] = rotation @ samples.base_specific_force[k] + compiled.opt.gravity
            data.qacc[3:6] = samples.base_angular_acceleration[k]
        joints = len(model.joints)
        data.qpos[data.qpos.size - joints :] = samples.position[k]
        data.qvel[data.qvel.size - joints :] = samples.velocity[k]
        data.qacc[data.qacc.size - joints :] = samples.acceleration[k]
        mujoco.mj_inverse(compiled, data)
        torque = data.qfrc_inverse.copy()
        for sensor, name in enumerate(samples.wrench_frames):
            site = data.site(name)
            axes = site.xmat.reshape(3, 3)
            moment = axes @ samples.wrenches[k, sensor, :3]
            force = axes @ samples.wrenches[k, sensor, 3:]
            body = compiled.site(name).bodyid[0]
            applied = np.zeros(compiled.nv)
            mujoco.mj_applyFT(compiled, data, force, moment, site.xpos, body, applied)
            torque -= applied
        if model.floating:
            torque[:6] = np.r_[torque[3:6], rotation.T @ torque[:3]]
        rows.append(torque)
    return np.array(rows)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("floating", [True, False])
def test_random_trees_obey_mujocos_inverse_dynamics(seed, floating):
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=3 + seed, floating=floating, wrench_frames=seed % 5)
    samples = random_samples(model, 20, rng)
    rows = equation_of_motion(ParameterSet(model), samples)
    wrench_part = rows.y - np.c_[np.zeros((20, 6 * floating)), samples.effort]
    left = rows.K @ ParameterSet(model).values - wrench_part
    assert relative_rmse(left, mujoco_inverse(model, samples, rng)) < 1e-11


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("floating", [True, False])
def test_drives_obey_mujocos_inverse_dynamics(seed, floating):
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=4 + seed, floating=floating, wrench_frames=0)
    driven = with_drives(model, rng, damping=5.0, armature=1.0)
    samples = random_samples(driven, 20, rng, ())
    parameters = ParameterSet(driven, ("viscous", "armature"))
    K = equation_of_motion(parameters, samples).K
    truth = mujoco_inverse(driven, samples, rng)
    assert relative_rmse(K @ parameters.values, truth) < 1e-11
    # The drives contribute a large part, and none of it acts on the base.
    bare = equation_of_motion(ParameterSet(model), samples).K @ ParameterSet(model).values
    base = 6 * floating
    assert relative_rmse(bare[:, base:], truth[:, base:]) > 0.05
    np.testing.assert_array_equal(K[:, :base, parameters.inertial :], 0)


@pytest.mark.parametrize("floating", [True, False])
def test_known_drives_are_subtracted_from_the_forces(floating):
    rng = np.random.default_rng(8)
    model = random_robot(8, links=6, floating=floating, wrench_frames=0)
    driven = with_drives(model, rng, damping=5.0, armature=1.0, friction_loss=3.0)
    samples = random_samples(driven, 20, rng, ())
    rows = equation_of_motion(ParameterSet(driven), samples)
    friction = np.array([joint.friction_loss for joint in driven.joints])
    # MuJoCo's inverse dynamics holds damping and armature; the constraint of dry friction is off.
    drives = mujoco_inverse(driven, samples, rng) - mujoco_inverse(model, samples, rng)
    drives[:, 6 * floating :] += friction * np.sign(samples.velocity)
    expected = np.c_[np.zeros((20, 6 * floating)), samples.effort] - drives
    np.testing.assert_allclose(rows.y, expected, atol=1e-10)


@pytest.mark.parametrize("floating", [True, False])
def test_links_without_parameters_have_no_columns(floating):
    """Virtual links stand between the joints of a body; a block is longer than the cache."""
    rng = np.random.default_rng(9)
    model = random_robot(9, links=7, floating=floating, wrench_frames=1)
    virtual = (2, 5)
    links = tuple(replace(link, virtual=i in virtual) for i, link in enumerate(model.links))
    samples = random_samples(model, CACHE_BLOCK // 7 + 3, rng)
    full = equation_of_motion(ParameterSet(model), samples)
    part = equation_of_motion(ParameterSet(replace(model, links=links)), samples)
    columns = [10 * i + k for i in range(7) if i not in virtual for k in range(10)]
    np.testing.assert_array_equal(part.K, full.K[:, :, columns])
    np.testing.assert_array_equal(part.y, full.y)
    one = equation_of_motion(ParameterSet(model), samples[-1:])
    np.testing.assert_allclose(full.K[-1:], one.K, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(full.y[-1:], one.y, rtol=1e-12)


def test_symbitron_obeys_mujocos_inverse_dynamics():
    rng = np.random.default_rng(1)
    model = load_model(CONFIG / "symbitron.xml")
    samples = random_samples(model, 50, rng, ("left_sole", "right_sole"))
    rows = equation_of_motion(ParameterSet(model), samples)
    wrench_part = rows.y - np.c_[np.zeros((50, 6)), samples.effort]
    left = rows.K @ ParameterSet(model).values - wrench_part
    assert relative_rmse(left, mujoco_inverse(model, samples, rng)) < 1e-11


def pinocchio_torque(model, path, samples, rng):
    """Return K φ with Pinocchio's own regressor and its own parameters, in our coordinates."""
    root = pinocchio.JointModelFreeFlyer() if model.floating else None
    pin = pinocchio.buildModelFromUrdf(str(path), *([root] if root else []))
    gravity = np.array([0, 0, -9.81])
    pin.gravity.linear = gravity
    data = pin.createData()
    phi = np.concatenate([inertia.toDynamicParameters() for inertia in pin.inertias[1:]])
    rows = []
    for k in range(len(samples)):
        q, v, a = pinocchio.neutral(pin), np.zeros(pin.nv), np.zeros(pin.nv)
        if model.floating:
            quaternion = rng.normal(size=4)
            q[3:7] = quaternion / np.linalg.norm(quaternion)
            rotation = pinocchio.Quaternion(q[3:7]).toRotationMatrix()
            v[:3], v[3:6] = rng.normal(size=3), samples.base_angular_velocity[k]
            # Pinocchio's is a spatial acceleration: the classical one less ω × v.
            a[:3] = samples.base_specific_force[k] + rotation.T @ gravity - np.cross(v[3:6], v[:3])
            a[3:6] = samples.base_angular_acceleration[k]
        for j, name in enumerate(model.joint_names):
            joint = pin.joints[pin.getJointId(name)]
            angle = samples.position[k, j]
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(angle), np.sin(angle)] if joint.nq == 2 else angle
            )
            v[joint.idx_v], a[joint.idx_v] = samples.velocity[k, j], samples.acceleration[k, j]
        torque = pinocchio.computeJointTorqueRegressor(pin, data, q, v, a) @ phi
        base = np.r_[torque[3:6], torque[:3]] if model.floating else []
        ours = [torque[pin.joints[pin.getJointId(name)].idx_v] for name in model.joint_names]
        rows.append(np.r_[base, ours])
    return np.array(rows)


@pytest.mark.parametrize("robot", REAL)
def test_real_robots_obey_pinocchios_regressor(robot):
    path, base = REAL[robot]
    rng = np.random.default_rng(2)
    model = load_model(path, base)
    samples = random_samples(model, 20, rng, ())
    parameters = ParameterSet(model)
    left = equation_of_motion(parameters, samples).K @ parameters.values
    # Pinocchio moves every joint independently; here a mimic joint's force acts on its leader.
    truth = pinocchio_torque(model, path, samples, rng)
    model.fold_followers(truth)
    assert relative_rmse(left, truth) < 1e-11


@pytest.mark.parametrize("seed", range(4))
def test_random_trees_obey_pinocchios_regressor(seed, tmp_path):
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=6)
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(model))
    samples = random_samples(model, 20, rng, ())
    parameters = ParameterSet(model)
    left = equation_of_motion(parameters, samples).K @ parameters.values
    assert relative_rmse(left, pinocchio_torque(model, path, samples, rng)) < 1e-11


@pytest.mark.parametrize(
    ("terms", "rank"), [((), 80), (("viscous", "coulomb"), 100), (REAL_TERMS, 160)]
)
def test_symbitron_has_the_thesis_base_parameters(terms, rank):
    model = load_model(CONFIG / "symbitron.urdf")
    samples = random_samples(model, 300, np.random.default_rng(3), ())
    K = equation_of_motion(ParameterSet(model, terms), samples).K
    W = K.reshape(-1, K.shape[2])
    values = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
    assert np.sum(values > 1e-9 * values[0]) == rank


def test_joint_columns_are_eq_2_49_with_armature_and_offset():
    model = load_model(CONFIG / "symbitron.urdf")
    samples = random_samples(model, 5, np.random.default_rng(5), ())
    assert np.all(is_slipping(samples.velocity, model.joints))
    parameters = ParameterSet(model, TERMS)
    values = np.arange(10.0) + 20 * np.arange(6)[:, None]
    viscous, coulomb, armature, offset, stribeck, stiffness = values
    phi = np.r_[np.zeros(110), values[:5].ravel(), np.zeros(20), stiffness, np.zeros(20)]
    torque = equation_of_motion(parameters, samples).K @ phi
    expected = viscous * samples.velocity + coulomb * np.sign(samples.velocity)
    expected += armature * samples.acceleration + offset + stiffness * samples.position
    expected += stribeck * np.sign(samples.velocity) * np.exp(-np.abs(samples.velocity) / 0.2)
    np.testing.assert_array_equal(torque[:, :6], 0)
    np.testing.assert_allclose(torque[:, 6:], expected, rtol=1e-14)


@pytest.mark.parametrize("floating", [True, False])
def test_load_friction_is_in_proportion_to_the_effort_without_friction(floating):
    model = random_robot(5, links=5, floating=floating, wrench_frames=1)
    frames = tuple(frame.name for frame in model.frames if frame.name.startswith("wrench"))
    samples = random_samples(model, 20, np.random.default_rng(1), frames)
    bare = ParameterSet(model)
    rows = equation_of_motion(bare, replace(samples, effort=np.zeros_like(samples.effort)))
    effort = (rows.K @ bare.values - rows.y)[:, 6 * floating :]
    parameters = ParameterSet(model, ("load",))
    K = equation_of_motion(parameters, samples).K
    joints = np.arange(len(model.joints))
    columns = K[:, 6 * floating + joints, parameters.term_columns["load"].start + joints]
    slips = is_slipping(samples.velocity, model.joints)
    expected = np.abs(effort) * np.sign(samples.velocity)
    np.testing.assert_allclose(columns[slips], expected[slips], rtol=1e-9)


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("terms", [TERMS, ("viscous", "load")])
def test_a_residual_without_its_regressor_is_that_of_the_rows(floating, terms):
    rng = np.random.default_rng(4)
    model = random_robot(4, links=5, floating=floating, wrench_frames=1)
    model = with_drives(model, rng, damping=5.0, armature=1.0, friction_loss=3.0)
    frames = tuple(frame.name for frame in model.frames if frame.name.startswith("wrench"))
    samples = random_samples(model, 20, rng, frames)
    parameters = ParameterSet(model, terms)
    payload = Payload(3, rng.normal(size=10), stop=int(samples.stamp[10]))
    parameters = replace(
        parameters, payloads=(payload,), reference=rng.normal(size=parameters.inertial)
    )
    phi = rng.normal(size=len(parameters))
    rows = equation_of_motion(parameters, samples)
    expected = rows.y - rows.K @ phi
    found = equation_residual(parameters, samples, phi)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())
