"""Friction of joints that MuJoCo simulates: it reverses ahead of the joint, and is soft."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from drive_logs import arm
from mujoco_joints import STEP, driven_joints

import symbid_ros as sy
from symbid_ros.dynamics.friction import CREEP_SPEED, coulomb_column, creep_column, lead_column
from symbid_ros.dynamics.samples import Samples

# MuJoCo's defaults of solimpfriction and solreffriction.
IMPEDANCE, LARGEST_IMPEDANCE, TIME_CONSTANT = 0.9, 0.95, 0.02


def with_drives(robot, friction, armature):
    joints = (replace(joint, friction_loss=friction, armature=armature) for joint in robot.joints)
    return replace(robot, joints=tuple(joints))


def test_friction_that_leads_is_found_beside_the_right_friction_and_armature():
    friction, armature = 1.5, 0.2
    log = driven_joints(with_drives(arm(), friction, armature), 15.0, 100.0, 20.0, seed=1)[0]
    result = sy.identify(arm(), log, unchecked=True)
    for joint in result.robot.joint_names:
        lead, coulomb, identified = (
            result.parameters[f"{joint}/{term}"] for term in ("lead", "coulomb", "armature")
        )
        # While a joint creeps, its friction is between the two signs.
        assert 0.4 * friction < lead.value < friction
        assert coulomb.value == pytest.approx(friction, abs=0.005)
        assert identified.value == pytest.approx(armature, abs=0.005)


def test_soft_friction_of_light_joints_is_not_taken_for_another_friction():
    friction, armature = 0.5, 0.02
    light = arm().with_phi(0.1 * arm().phi)
    log = driven_joints(with_drives(light, friction, armature), 40.0, 20.0, 2.0, seed=1)[0]
    result = sy.identify(light, log, unchecked=True)
    for joint in result.robot.joint_names:
        coulomb, creep = (result.parameters[f"{joint}/{term}"] for term in ("coulomb", "creep"))
        assert 0.1 * friction < creep.value < friction
        assert coulomb.value == pytest.approx(friction, abs=3e-4)
    assert not any(name.endswith("/stribeck") for name in result.parameters)
    # Without the term 0.17 %.
    assert result.estimate.holdout.percent_after < 0.06


def test_the_columns_are_mujocos_friction():
    """Between ∓ the speed of the ramp friction is proportional to q̇ + t q̈, beyond it constant."""
    friction = 0.4
    ahead = 0.5 * LARGEST_IMPEDANCE * TIME_CONSTANT
    inertia = (1 - IMPEDANCE) / IMPEDANCE * ahead * friction / CREEP_SPEED[0]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}"/><worldbody><body>'
        f'<joint axis="0 0 1" frictionloss="{friction}"/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>'
        "</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    rows = np.empty((8000, 4))
    for row in rows:
        angle = 1.3 * data.time
        errors = 0.25 * np.sin(angle) - data.qpos, 0.325 * np.cos(angle) - data.qvel
        data.qfrc_applied = 40 * errors[0] + 4 * errors[1]
        mujoco.mj_forward(model, data)
        row[:] = *data.qpos, *data.qvel, *data.qacc, *data.qfrc_constraint
        mujoco.mj_step(model, data)
    position, velocity, acceleration, force = rows.T[:, :, None]
    empty = Samples.none(("joint",))
    samples = replace(empty, position=position, velocity=velocity, acceleration=acceleration)
    joints = [next(one for one in arm().joints if one.kind == "revolute")]
    columns = (
        coulomb_column(velocity, joints),
        lead_column(samples, joints),
        creep_column(samples, joints),
    )
    np.testing.assert_allclose(-friction * sum(columns), force, atol=1e-12)
    assert np.mean(np.abs(velocity) < CREEP_SPEED[0]) > 0.1
