"""The robot lifts its feet: its plan, its balance on one leg, and what the plates read."""

import mujoco
import numpy as np
import pytest

from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.smooth_path import MIDWAY_SPEED, MinimumJerkPath, pendulum_path

MASS, GRAVITY = 41.05, 9.81
LEFT, RIGHT = 0, 1


def longest_run(flags: np.ndarray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def test_a_move_has_minimum_jerk_also_through_a_point_midway():
    straight, through = MinimumJerkPath(np.zeros(2)), MinimumJerkPath(np.zeros(2))
    target = np.array([0.3, -0.1])
    straight.move_to(target, 2.0)
    through.move_to(target / 2.0, 1.0, MIDWAY_SPEED / 2.0 * target)
    through.move_to(target, 1.0)
    for time in np.linspace(0.0, 2.0, 9):
        u = time / 2.0
        closed = [
            u**3 * (10.0 - 15.0 * u + 6.0 * u**2),
            30.0 * u**2 * (1.0 - u) ** 2 / 2.0,
            60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / 4.0,
        ]
        for path in (straight.path(), through.path()):
            np.testing.assert_allclose(path.at(time), np.outer(closed, target), atol=1e-12)
    assert not straight.path().at(2.1)[1:].any()


def test_centre_of_pressure_of_the_pendulum_follows_its_path():
    builder = MinimumJerkPath(np.array([0.0]))
    builder.rest_until(2.0)
    builder.move_to(np.array([0.13]), 1.0)
    builder.rest_until(5.0)
    pressure = builder.path()
    mass = pendulum_path(pressure, 0.9, GRAVITY)
    for time in np.linspace(0.0, 5.0, 101):
        position, _, acceleration = mass.at(time)[:, 0]
        expected = pressure.at(time)[0, 0]
        assert position - 0.9 / GRAVITY * acceleration == pytest.approx(expected, abs=2e-5)


def test_a_step_unloads_one_plate_and_ends_on_both_feet(stepping, body):
    force = stepping.array("wrenches")[:, :, 2]
    airborne = np.all(stepping.array("wrenches")[:, LEFT] == 0.0, axis=1)
    assert 0.6 < 1e-3 * longest_run(airborne) < 1.0
    np.testing.assert_allclose(force[airborne, RIGHT].mean(), MASS * GRAVITY, rtol=2e-3)
    np.testing.assert_allclose(force[-1], MASS * GRAVITY / 2.0, rtol=0.05)
    heights, places = [], []
    for instant in stepping.instants[::10]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        heights.append(body.site("left_sole")[0][2])
        places.append(body.site("right_sole")[0])
    assert 0.05 < max(heights) < 0.22
    np.testing.assert_allclose(places - places[0], 0.0, atol=1e-3)
    # The foot comes down flat, with no more than its own weight's impact.
    assert heights[-1] == pytest.approx(heights[0], abs=5e-4)
    assert force.max() < 1.1 * MASS * GRAVITY


def test_gravity_alone_changes_the_angular_momentum_about_the_undriven_ankle(stepping, body):
    """The premise of balance on one leg, from the true motion."""
    airborne = np.all(stepping.array("wrenches")[:, LEFT] == 0.0, axis=1)
    start = int(np.flatnonzero(airborne)[200])
    momenta, arms = [], []
    for instant in stepping.instants[start : start + 400]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        mujoco.mj_comPos(body.model, body.data)
        mujoco.mj_comVel(body.model, body.data)
        mujoco.mj_subtreeVel(body.model, body.data)
        _, y, z = arm = body.data.subtree_com[1] - body.data.joint("R_aie").xanchor
        _, y_rate, z_rate = body.data.subtree_linvel[1]
        momenta.append(body.data.subtree_angmom[1][0] + MASS * (y * z_rate - z * y_rate))
        arms.append(arm[1])
    impulse = -MASS * GRAVITY * 1e-3 * np.cumsum(arms)
    change = np.array(momenta[1:]) - momenta[0]
    # The inertia of the resting foot and its small roll remain.
    np.testing.assert_allclose(change, impulse[:-1], atol=0.02 * np.ptp(momenta) + 2e-3)


def test_the_robot_stands_on_each_leg_while_the_other_foot_moves():
    run = list(Simulator(SimulateOptions("one_leg", moves=1, motion_seed=1, ideal=True)))
    unloaded = ~np.array([instant.wrenches for instant in run])[:, :, 2].astype(bool)
    for foot in (LEFT, RIGHT):
        assert longest_run(unloaded[:, foot]) > 2500
    assert np.abs([instant.true_acceleration for instant in run[-500:]]).max() < 2.0
