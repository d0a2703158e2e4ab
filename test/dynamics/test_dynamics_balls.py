"""Feet that are balls touch the ground at their lowest point, wherever the leg points."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import with_contacts, without_contacts
from symbid_ros.dynamics.upright import upward
from symbid_ros.model.load import load_model

RADIUS, STEP, EVERY = 0.04, 1e-3, 4
LEGS = {"left": "0.2 0.2", "right": "0.2 -0.2", "rear": "-0.25 0"}
LEG = """
  <body name="{name}_thigh" pos="{place} 0">
   <joint name="{name}_hip" axis="0 1 0"/><geom type="capsule" size="0.02 0.1" pos="0 0 -0.1"
    contype="0" conaffinity="0"/>
   <body name="{name}_shin" pos="0 0 -0.25">
    <joint name="{name}_knee" axis="1 0.3 0"/>
    <geom name="{name}_foot" type="sphere" size="{radius}" pos="0.01 0 -0.25" mass="0.3"/>
   </body>
  </body>"""
ROBOT = """<mujoco><option gravity="0 0 -9.81"/><default><geom density="500"/></default><worldbody>
 <body name="trunk" pos="0 0 {height}"><freejoint/>
  <geom type="box" size="0.3 0.25 0.05" contype="0" conaffinity="0"/>{legs}
 </body></worldbody></mujoco>"""


def robot_text():
    legs = "".join(
        LEG.format(name=name, place=place, radius=RADIUS) for name, place in LEGS.items()
    )
    return ROBOT.format(height=0.5 + RADIUS - 1e-3, legs=legs)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(robot_text())
    return load_model(path)


@pytest.fixture(scope="module")
def standing():
    """Return samples of 4 s on the floor, and the generalised forces (N, n) of its contacts."""
    spec = mujoco.MjSpec.from_string(robot_text())
    hard = {"solref": [0.004, 1], "solimp": [0.99, 0.999, 0.001, 0.5, 2], "priority": 1}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], **hard)
    model = spec.compile()
    model.opt.timestep = STEP
    data = mujoco.MjData(model)
    base, columns = model.body("trunk").id, {name: [] for name in ("q", "v", "w", "f", "force")}
    phase = np.arange(6)
    for count in range(5000):
        time = count * STEP
        target = 0.15 * min(time, 1.0) * np.sin((3 + 0.7 * phase) * time + phase)
        data.qfrc_applied[6:] = 300 * (target - data.qpos[7:]) - 8 * data.qvel[6:]
        mujoco.mj_forward(model, data)
        if count >= 1000 and count % EVERY == 0:
            axes = data.xmat[base].reshape(3, 3)
            acceleration = np.zeros(6)
            mujoco.mj_rnePostConstraint(model, data)
            kind = mujoco.mjtObj.mjOBJ_XBODY
            mujoco.mj_objectAcceleration(model, data, kind, base, acceleration, 1)
            contact = data.qfrc_constraint
            columns["q"].append(data.qpos[7:].copy())
            columns["v"].append(data.qvel[6:].copy())
            columns["w"].append(data.qvel[3:6].copy())
            columns["f"].append(acceleration[3:].copy())
            columns["force"].append(np.r_[contact[3:6], axes.T @ contact[:3], contact[6:]])
        mujoco.mj_step(model, data)
    q, v, w, f, force = (np.array(each) for each in columns.values())
    count = len(q)
    stamp = np.arange(count) * round(1e9 * STEP * EVERY)
    none, wrenches = np.zeros((count, 3)), np.zeros((count, 0, 6))
    return Samples(stamp, q, v, 0 * v, 0 * v, w, none, f, wrenches, ()), force


def left_over(model, samples, force):
    rows = without_contacts(model, samples, force[..., None])
    return float(np.sqrt(np.mean(rows**2)))


def test_forces_at_the_bottom_of_balls_enter_no_row(robot, standing):
    samples, force = standing
    feet = [f"{name}_foot" for name in LEGS]
    at_bottoms, at_centres = (
        left_over(with_contacts(robot, [f"{foot}:{kind}" for foot in feet]), samples, force)
        for kind in ("point", "0")
    )
    # The rest is of the depth to which MuJoCo's balls sink, and of the mean acceleration.
    assert at_bottoms < 0.1 * at_centres
    assert at_centres > 1e-3 * np.sqrt(np.mean(force**2))
    named = with_contacts(robot, [f"{foot}:point" for foot in feet]).contacts
    assert named.names == tuple(f"{foot}:{RADIUS:g}" for foot in feet)
    # The direction upwards can also be given.
    known = replace(samples, upward=upward(samples))
    assert left_over(with_contacts(robot, named.names), known, force) == pytest.approx(at_bottoms)


def test_a_turning_base_knows_what_is_above():
    """Turns about all axes, with accelerations whose mean is zero, in closed form."""
    count, period = 2000, 0.002
    time = period * np.arange(count)
    rate = np.stack([0.8 * np.cos(3 * time), 0.5 * np.sin(2 * time), 0.3 + 0 * time], axis=1)
    axes = np.empty((count, 3, 3))
    axes[0] = np.eye(3)
    for index in range(1, count):
        middle = 0.5 * (rate[index] + rate[index - 1]) * period
        quaternion, turn = np.empty(4), np.empty(9)
        angle = np.linalg.norm(middle)
        mujoco.mju_axisAngle2Quat(quaternion, middle / angle, angle)
        mujoco.mju_quat2Mat(turn, quaternion)
        axes[index] = axes[index - 1] @ turn.reshape(3, 3)
    moves = np.sin(2 * np.pi * 3 * time / 4)[:, None] * [2.0, 1.0, -1.0]
    moves[:, 2] += 9.81
    force = np.einsum("tji,tj->ti", axes, moves)
    none, wrenches = np.zeros((count, 0)), np.zeros((count, 0, 6))
    stamp = np.rint(1e9 * time).astype(np.int64)
    samples = Samples(stamp, none, none, none, none, rate, rate, force, wrenches, ())
    np.testing.assert_allclose(upward(samples), axes[:, 2], atol=1e-3)
    # After a pause it starts anew, because the base may have turned meanwhile.
    later = replace(samples, stamp=stamp + np.where(time < 2, 0, 10**10))
    halves = [upward(samples[:1000]), upward(samples[1000:])]
    np.testing.assert_allclose(upward(later), np.concatenate(halves), atol=1e-12)
