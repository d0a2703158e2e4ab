"""Alarms about joints whose efforts a model does not predict."""

import re

import numpy as np
import pytest
from drive_logs import RATE, arm, drives, log_of

import symbid_ros as sy
from symbid_ros.estimation.alarms import Alarm


@pytest.mark.parametrize(("links", "asks_for_the_joint"), [(2, False), (4, True)])
def test_only_a_robot_with_several_joints_can_confuse_them(links, asks_for_the_joint) -> None:
    robot = arm(seed=5, links=links)
    joints = log_of(robot, drives(robot, viscous=0.4), seed=1).streams().joints
    time = 1e-9 * (joints.stamp - joints.stamp[0])
    effort = joints.effort.copy()
    effort[:, 0] = 20 * np.sin(9.1 * time + 3 * np.sin(2.3 * time))
    log = sy.Log.from_arrays(robot, time=time, position=joints.position, effort=effort)
    alarms = sy.identify(robot, log, unchecked=True).alarms
    (told,) = [one for one in alarms if Alarm.UNPREDICTED_EFFORT in one and "joint_0" in one]
    assert ("which joint" in told) is asks_for_the_joint


@pytest.mark.parametrize("terms", ["auto", "viscous"])
def test_a_small_effort_under_white_noise_is_no_alarm(terms) -> None:
    robot = arm(seed=5)
    joints = log_of(robot, drives(robot, viscous=0.4), seed=1).streams().joints
    time = 1e-9 * (joints.stamp - joints.stamp[0])
    effort = joints.effort.copy()
    # Averages over windows are noise mostly, although it is a tenth of that in single samples.
    window = 0.64
    assert RATE * window > 100
    noise = np.random.default_rng(0).normal(size=len(time))
    effort[:, -1] += 30 * effort[:, -1].std() * noise
    log = sy.Log.from_arrays(robot, time=time, position=joints.position, effort=effort)
    found = sy.identify(robot, log, unchecked=True, window=window, joint_terms=terms)
    assert not found.alarms


def test_stamps_of_a_wrong_rate_come_before_other_alarms() -> None:
    """Ten times too fast, they make accelerations a hundred times too large."""
    robot = arm(seed=2, links=4)
    joints = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8)).streams().joints
    velocity = np.gradient(joints.position, 1e-9 * joints.stamp, axis=0)
    log = sy.Log.from_arrays(
        robot,
        time=1e-10 * joints.stamp,
        position=joints.position,
        velocity=velocity,
        effort=joints.effort,
    )
    found = sy.identify(robot, log)
    assert re.search("is 0.1 times the rate .* check the rate of the stamps", found.alarms[0])


def test_a_joint_at_rest_without_effort_beside_an_unpredicted_one() -> None:
    robot = arm(seed=5)
    moving = np.array([1.0, 1.0, 0.0])
    joints = log_of(robot, drives(robot, viscous=0.4), seed=1, moving=moving).streams().joints
    time = 1e-9 * (joints.stamp - joints.stamp[0])
    position, effort = joints.position.copy(), joints.effort.copy()
    position[:, -1], effort[:, -1] = 0.0, np.nan
    effort[:, 0] = 20 * np.sin(9.1 * time + 3 * np.sin(2.3 * time))
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    with np.errstate(invalid="raise"):
        alarms = sy.identify(robot, log, unchecked=True).alarms
    assert any(Alarm.UNPREDICTED_EFFORT in one and "joint_0" in one for one in alarms)
