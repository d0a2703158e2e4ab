"""Friction that reverses ahead of a joint, in the log of an arm that MuJoCo simulates."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from drive_logs import arm

import symbid_ros as sy
from symbid_ros.model.export_mjcf import mjcf_text

STEP, STEPS = 1e-3, 15_000
FRICTION, ARMATURE = 1.5, 0.2


def simulated(robot):
    """Return a noisy log of MuJoCo's joints, with the softness of friction that it has."""
    model = mujoco.MjModel.from_xml_string(mjcf_text(robot))
    model.opt.timestep = STEP
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    frequency, phase = rng.uniform(0.5, 3.0, (4, model.nv)), rng.uniform(0, 6, (4, model.nv))
    rows = np.empty((STEPS, 2, model.nv))
    for row in rows:
        angle = phase + frequency * data.time
        wanted, rate = np.sin(angle).sum(axis=0) / 4, (frequency * np.cos(angle)).sum(axis=0) / 4
        data.qfrc_applied = 100 * (wanted - data.qpos) + 20 * (rate - data.qvel)
        row[:] = data.qpos, data.qfrc_applied
        mujoco.mj_step(model, data)
    position, effort = rows.transpose(1, 0, 2)
    effort += 2e-3 * np.sqrt(np.mean(effort**2, axis=0)) * rng.normal(size=effort.shape)
    time = STEP * np.arange(STEPS)
    return sy.Log.from_arrays(robot, time=time, position=position, effort=effort, start=1.0)


def test_friction_that_leads_is_found_beside_the_right_friction_and_armature():
    joints = tuple(
        replace(joint, friction_loss=FRICTION, armature=ARMATURE) for joint in arm().joints
    )
    log = simulated(replace(arm(), joints=joints))
    result = sy.identify(arm(), log, unchecked=True)
    for joint in result.robot.joint_names:
        lead, coulomb, armature = (
            result.parameters[f"{joint}/{term}"] for term in ("lead", "coulomb", "armature")
        )
        # While a joint creeps, its friction is between the two signs.
        assert 0.4 * FRICTION < lead.value < FRICTION
        assert coulomb.value == pytest.approx(FRICTION, abs=0.005)
        assert armature.value == pytest.approx(ARMATURE, abs=0.005)
