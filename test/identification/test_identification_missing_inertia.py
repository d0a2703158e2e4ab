"""Efforts with the gravity of a robot but without its inertia, as of a gravity compensation."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from random_robots import random_robot

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.conventions.missing_inertia import find_missing_inertia
from symbid_ros.identification.log_reading import first_segments

SEEDS = 1, 2, 5


def arm_and_log(seed, *, by_hand=False, slower=1.0, unit=1.0):
    """Return an arm and its log, in which drives move it, or a gravity compensation carries it."""
    robot = arm(seed=seed, links=5)
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    joints = log_of(robot, truth, seed=seed).streams().joints
    effort, position = joints.effort, joints.position
    if by_hand:
        rest = np.zeros_like(position)
        weight = sy.regressor(robot, position, rest, rest) @ robot.inertial_parameters
        noise = np.random.default_rng(seed).normal(size=weight.shape)
        effort = 1.1 * weight + 1e-3 * noise
    time = 1e-9 * slower * (joints.stamp - joints.stamp[0])
    return robot, sy.Log.from_arrays(robot, time=time, position=position, effort=unit * effort)


def lacking(robot, log):
    return find_missing_inertia(first_segments(log, robot), robot)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_efforts_of_a_gravity_compensation_have_no_inertia(seed, unit) -> None:
    assert lacking(*arm_and_log(seed, unit=unit)) == ()
    assert lacking(*arm_and_log(seed, by_hand=True, unit=unit))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_slow_log_does_not_show_whether_there_is_inertia(seed) -> None:
    assert lacking(*arm_and_log(seed, by_hand=True, slower=30.0)) == ()


def test_constant_gravity_does_not_tell_the_unit_of_efforts() -> None:
    """A slide's weight acts like a constant torque, so its size in unknown units is not known."""
    robot = random_robot(30, links=2, floating=False, wrench_frames=0)
    log = log_of(robot, drives(robot), seed=30, slowdown=0.2, seconds=12.0, gain=10.0)
    assert lacking(robot, log) == ()


def test_doctor_and_identification_name_the_cause_first() -> None:
    robot, log = arm_and_log(1, by_hand=True)
    joints = lacking(robot, log)
    kinds = {one.kind: one for one in sy.diagnose(robot, log).findings}
    assert kinds[Kind.MISSING_INERTIA].figures == {"joints": len(joints)}
    assert Kind.TORQUE_GAIN not in kinds
    alarm, *others = sy.identify(robot, log).alarms
    assert Alarm.MISSING_INERTIA in alarm
    assert all(name in alarm for name in joints)
    assert alarm.endswith("may follow from this") is bool(others)
