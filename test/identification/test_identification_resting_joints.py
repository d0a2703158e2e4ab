"""Joints whose position does not change: at rest, or with a frozen encoder."""

from dataclasses import replace

import numpy as np
import pytest
from arm_log import arm_streams
from drive_logs import arm

import symbid_ros as sy
from symbid_ros.identification.terms.resting_joints import motionless_joints
from symbid_ros.signals.alignment import align


@pytest.fixture(scope="module")
def robot():
    model = arm(seed=2)
    joints = tuple(replace(one, effort=50.0, lower=-2.0, upper=2.0) for one in model.joints)
    return replace(model, joints=joints)


def with_position(streams, column, values):
    position = streams.joints.position.copy()
    position[:, column] = values
    return replace(streams, joints=replace(streams.joints, position=position))


def identified(robot, streams):
    return sy.identify(robot, sy.Log.from_streams(streams))


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_a_frozen_encoder_is_named_and_explained_by_no_spring(robot, noise, caplog):
    streams = arm_streams(robot, seconds=24.0, seed=1)
    count = len(streams.joints.stamp)
    frozen = 0.3 + noise * np.random.default_rng(2).standard_normal(count)
    found = identified(robot, with_position(streams, 1, frozen))
    name = robot.joint_names[1]
    (alarm,) = (one for one in found.alarms if one.startswith(f"{name} does not move"))
    assert "encoder is frozen" in alarm
    assert not any("although the joint moves" in one for one in found.alarms if name in one)
    assert not any("sensor_errors" in one for one in found.alarms)
    assert not [one for one in found.parameters if one.endswith("/stiffness")]
    assert "springs act" not in caplog.text


def test_efforts_of_an_arm_that_stands_still_are_not_those_of_moving_joints(robot):
    streams = arm_streams(robot, seconds=24.0, seed=1)
    position = np.repeat(streams.joints.position[:1], len(streams.joints.stamp), axis=0)
    found = identified(robot, replace(streams, joints=replace(streams.joints, position=position)))
    assert any("do not move in this log" in one for one in found.alarms)
    assert not any("although the joint moves" in one for one in found.alarms)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_joint_at_rest_is_no_alarm(robot, friction):
    name = robot.joint_names[1]
    streams = arm_streams(robot, seconds=24.0, seed=1, friction=friction, resting=(name,))
    found = identified(robot, streams)
    assert not any("not move" in one for one in found.alarms)


def test_joints_rest_that_move_by_less_than_a_milliradian(robot):
    streams = arm_streams(robot, seconds=10.0)
    count = len(streams.joints.stamp)
    for size, rests in ((0.9e-3, True), (1.1e-3, False)):
        wave = size * np.sqrt(2) * np.sin(2 * np.pi * np.arange(count) / count * 7)
        segments = align(with_position(streams, 1, 100.0 + wave), robot)
        position = np.concatenate([one.position for one in segments])
        assert motionless_joints(position, robot).tolist() == [False, rests, False]
    assert not motionless_joints(position[:0], robot).any()
