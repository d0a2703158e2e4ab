"""Joint terms against a MuJoCo robot that moves under dry friction."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_robots import CONFIG, random_robot, random_samples, with_drives

from symbid_ros.choices import TERMS as ALL_TERMS
from symbid_ros.dynamics.friction import (
    COULOMB_RAMP,
    COULOMB_SPEED,
    PRESLIDING_TRAVEL,
    by_kind,
    coulomb_column,
    friction_state,
    is_slipping,
    lead_column,
    presliding_column,
)
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

# Without Stribeck friction, which neither a model file nor MuJoCo has.
TERMS = ALL_TERMS[:4]

JOINT = random_robot(1).joints[0]

DRY = mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF


def dahl(position, travel):
    """Integrate dz/dq = (sign(q̇) - z)/x from sample to sample."""
    state = np.empty_like(position)
    state[0] = now = np.sign(position[1] - position[0])
    for index, step in enumerate(np.diff(position, axis=0)):
        now = np.sign(step) - (np.sign(step) - now) * np.exp(-np.abs(step) / travel)
        state[index + 1] = now
    return state


def forward(model, samples, rng, *, soft=False):
    """Return the samples with MuJoCo's accelerations, and its dry friction (N, J)."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(model))
    # MuJoCo's dry friction is a soft constraint: with the default time constant of 20 ms, a joint
    # under a large force creeps. The shortest time constant gives Coulomb friction.
    if not soft:
        compiled.opt.timestep, compiled.dof_solref[:] = 1e-5, (2e-5, 1.0)
        compiled.dof_solimp[:, :2] = 0.9999
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(compiled)
    joints, base, friction, motion = len(model.joints), [], [], []
    for k in range(len(samples)):
        rotation = np.eye(3)
        if model.floating:
            quaternion = rng.normal(size=4)
            data.qpos[3:7] = quaternion / np.linalg.norm(quaternion)
            flat = np.empty(9)
            mujoco.mju_quat2Mat(flat, data.qpos[3:7])
            rotation = flat.reshape(3, 3)
            data.qvel[3:6] = samples.base_angular_velocity[k]
        data.qpos[compiled.nq - joints :] = samples.position[k]
        data.qvel[compiled.nv - joints :] = samples.velocity[k]
        data.qfrc_applied[compiled.nv - joints :] = samples.effort[k]
        mujoco.mj_forward(compiled, data)
        assert np.all(data.efc_type == DRY)
        # One row a joint, in the joints' order: the Jacobian is the identity.
        friction.append(data.efc_force.copy())
        np.testing.assert_array_equal(data.efc_id, np.arange(joints) + compiled.nv - joints)
        motion.append(data.qacc[compiled.nv - joints :].copy())
        if model.floating:
            force = rotation.T @ (data.qacc[:3] - compiled.opt.gravity)
            base.append([force, data.qacc[3:6].copy()])
    moved = replace(samples, acceleration=np.array(motion))
    if model.floating:
        force, turn = np.array(base).swapaxes(0, 1)
        moved = replace(moved, base_specific_force=force, base_angular_acceleration=turn)
    return moved, np.array(friction)


def moving(model, count, rng, lowest):
    """Return random samples in which every joint is faster than ``lowest``."""
    samples = random_samples(model, count, rng, ())
    speed = lowest + rng.uniform(0, 3, samples.velocity.shape)
    return replace(samples, velocity=speed * rng.choice([-1, 1], speed.shape))


def robots():
    """Yield trees with floating and fixed bases, slides among their joints, and Symbitron."""
    for seed in range(4):
        yield random_robot(seed, links=6 + seed, floating=seed % 2 == 0, wrench_frames=0)
    yield load_model(CONFIG / "symbitron.xml")


@pytest.fixture(params=robots(), ids=lambda model: model.name)
def robot(request):
    return with_drives(request.param, np.random.default_rng(100))


def test_slipping_joints_obey_mujocos_dry_friction(robot):
    rng = np.random.default_rng(1)
    samples, friction = forward(robot, moving(robot, 30, rng, 1.0), rng)
    parameters = ParameterSet(robot, TERMS)
    coulomb = parameters.values[parameters.term_columns["coulomb"]]
    np.testing.assert_allclose(-friction, coulomb * np.sign(samples.velocity), rtol=1e-9)
    rows = equation_of_motion(parameters, samples)
    error = rows.K @ parameters.values - rows.y
    assert np.abs(error).max() < 1e-9 * np.abs(rows.y).max()


def test_the_lead_is_that_of_mujocos_default_friction(robot):
    rng = np.random.default_rng(5)
    samples, friction = forward(robot, moving(robot, 60, rng, 0.01), rng, soft=True)
    share = -friction / [joint.friction_loss for joint in robot.joints]
    reverses = share * samples.velocity < 0
    slips = np.abs(share) > 1 - 1e-9
    assert np.mean(reverses & slips) > 0.02
    column = coulomb_column(samples.velocity, robot.joints) + lead_column(samples, robot.joints)
    np.testing.assert_array_equal(np.sign(column[slips]), np.sign(share[slips]))


def test_the_columns_recover_mujocos_friction(robot):
    rng = np.random.default_rng(2)
    parameters = ParameterSet(robot, TERMS)
    samples = moving(robot, 40, rng, 1.0)
    offset = rng.normal(size=len(robot.joints))
    samples, _ = forward(robot, samples, rng)
    # A drive whose torque reading has an offset.
    rows = equation_of_motion(parameters, replace(samples, effort=samples.effort + offset))
    known, sought = np.split(parameters.values, [parameters.inertial])
    y = rows.y - rows.K[:, :, : parameters.inertial] @ known
    W = rows.K[:, :, parameters.inertial :].reshape(-1, len(sought))
    found, _, rank, _ = np.linalg.lstsq(W, y.ravel())
    assert rank == len(sought)
    sought[-len(offset) :] = offset
    np.testing.assert_allclose(found, sought, atol=1e-8)


def test_a_sticking_joint_has_less_than_its_coulomb_friction(robot):
    rng = np.random.default_rng(3)
    samples = random_samples(robot, 30, rng, ())
    bound = np.full(len(robot.joints), 40.0)
    robot = replace(robot, joints=tuple(replace(j, friction_loss=40.0) for j in robot.joints))
    samples = replace(samples, velocity=np.zeros_like(samples.velocity))
    samples, friction = forward(robot, samples, rng)
    share = friction / bound
    assert np.abs(share).max() < 1 + 1e-9
    stuck = np.abs(share) < 1 - 1e-9
    assert stuck.mean() > 0.25
    # Static friction takes any value between the bounds, so these rows are left out.
    assert share[stuck].std() > 0.25
    assert not is_slipping(samples.velocity, robot.joints).any()
    assert not coulomb_column(samples.velocity, robot.joints).any()


def test_each_joint_term_is_only_in_its_joints_row(robot):
    parameters = ParameterSet(robot, TERMS)
    structure = RowLayout.of(parameters).structure
    joints = len(robot.joints)
    for columns in parameters.term_columns.values():
        expected = np.vstack([np.zeros((6 * robot.floating, joints)), np.eye(joints)])
        np.testing.assert_array_equal(structure[:, columns], expected)
    bare = RowLayout.of(ParameterSet(robot)).structure
    np.testing.assert_array_equal(structure[:, : parameters.inertial], bare)


speeds = st.floats(-1e3, 1e3, allow_nan=False)


@given(speeds, st.sampled_from(["revolute", "prismatic"]))
def test_the_coulomb_column_is_the_sign_of_a_joint_that_slips(speed, kind):
    joints = [replace(JOINT, kind=kind)]
    velocity = np.array([[speed]])
    column, slipping = coulomb_column(velocity, joints), is_slipping(velocity, joints)
    ramp = by_kind(COULOMB_RAMP, joints)[0]
    assert slipping == (abs(speed) >= by_kind(COULOMB_SPEED, joints)[0])
    if abs(speed) >= ramp:
        assert column == np.sign(speed)
    else:
        assert column == pytest.approx(speed / ramp)
    assert coulomb_column(-velocity, joints) == -column


@pytest.mark.parametrize("count", [2, 3, 500])
def test_the_state_of_friction_is_dahls(count):
    rng = np.random.default_rng(4)
    model = load_model(CONFIG / "symbitron.xml")
    hinges = [joint for joint in model.joints if joint.kind == "revolute"][:3]
    slide = replace(hinges[0], kind="prismatic")
    position = np.cumsum(rng.normal(size=(count, 4)), axis=0) * 1e-3
    travel = np.array([PRESLIDING_TRAVEL[0]] * 3 + [PRESLIDING_TRAVEL[1]])
    found = friction_state(position, [*hinges, slide])
    np.testing.assert_allclose(found, dahl(position, travel), atol=1e-12)


def test_presliding_needs_no_memory_while_a_joint_accelerates_constantly():
    robot = random_robot(1, links=4, floating=False, wrench_frames=0)
    joints = robot.joints
    time = np.arange(-1.0, 1.0, 1e-4)[:, None]
    acceleration = np.random.default_rng(2).uniform(0.5, 2.0, len(joints))
    samples = random_samples(robot, len(time), np.random.default_rng(3), ())
    samples = replace(
        samples,
        position=0.5 * acceleration * time**2,
        velocity=acceleration * time,
        acceleration=np.broadcast_to(acceleration, samples.acceleration.shape),
    )
    state = friction_state(samples.position, joints)
    remembered = presliding_column(replace(samples, friction_state=state), joints)
    np.testing.assert_allclose(presliding_column(samples, joints), remembered, atol=5e-3)
    # Friction lags behind a reversal only.
    before = time[:, 0] < -np.max(by_kind(COULOMB_SPEED, joints) / acceleration)
    np.testing.assert_allclose(remembered[before], 0, atol=1e-12)
    assert remembered.min() < -0.9
