"""Logs of joints that MuJoCo drives along random sums of sines."""

import mujoco
import numpy as np

import symbid_ros as sy
from symbid_ros.model.export_mjcf import mjcf_text

STEP = 1e-3


def driven_joints(robot, seconds, stiffness, damping, *, seed, has_stops=False):
    """Return a noisy log, the joints' true positions, and the forces of MuJoCo's constraints.

    These are the forces of end stops, if the joints have any and their friction is zero.
    """
    model = mujoco.MjModel.from_xml_string(mjcf_text(robot))
    model.opt.timestep = STEP
    if not has_stops:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.5, 3.0, (4, model.nv)), rng.uniform(0, 6, (4, model.nv))
    rows = np.empty((round(seconds / STEP), 3, model.nv))
    for row in rows:
        angle = phase + frequency * data.time
        wanted, rate = np.sin(angle).sum(axis=0) / 4, (frequency * np.cos(angle)).sum(axis=0) / 4
        data.qfrc_applied = stiffness * (wanted - data.qpos) + damping * (rate - data.qvel)
        row[:2] = data.qpos, data.qfrc_applied
        mujoco.mj_step(model, data)
        row[2] = data.qfrc_constraint  # at the state before the step
    position, effort, constraint = rows.transpose(1, 0, 2)
    noise = 2e-3 * np.sqrt(np.mean(effort**2, axis=0)) * rng.normal(size=effort.shape)
    time = STEP * np.arange(len(rows))
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort + noise, start=1.0)
    return log, position, constraint
