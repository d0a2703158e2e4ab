"""Joints that follow others: positions that do not, and efforts that are not used."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.followers import FollowerCheck
from symbid_ros.model.tree import Mimic
from symbid_ros.signals.streams import JointStream

NAMES = ("hip", "knee", "foot", "toe")
COUNT = 1001
TIME = np.arange(COUNT) * 1e-2
MULTIPLIER, OFFSET = -2.0, 0.1


def robot(kind="revolute", followers=1):
    """Return a robot whose last joints follow the second one."""
    model = random_robot(0, links=5, floating=True)
    joints = [
        replace(joint, name=name, kind="revolute", effort=1.0, mimic=None)
        for name, joint in zip(NAMES, model.joints, strict=True)
    ]
    for index in range(len(NAMES) - followers, len(NAMES)):
        mimic = Mimic(1, MULTIPLIER, OFFSET)
        joints[index] = replace(joints[index], kind=kind, mimic=mimic, effort=0.0)
    return replace(model, joints=tuple(joints))


def stream(multiplier=MULTIPLIER, offset=OFFSET, size=0.5, noise=0.0, effort=0.0):
    """Return messages in which toe is a linear function of knee."""
    position = size * np.sin(TIME[:, None] + np.arange(4))
    position[:, 3] = multiplier * position[:, 1] + offset
    position[:, 3] += noise * np.random.default_rng(0).normal(size=COUNT)
    efforts = np.ones((COUNT, 4))
    efforts[:, 2:] = effort
    stamp = 10_000_000 * np.arange(COUNT, dtype=np.int64)
    return JointStream("/joints", NAMES, stamp, position, np.cos(position), efforts)


def findings(joints, model, slices=3):
    check = FollowerCheck("/joints", model)
    ends = np.linspace(0, joints.stamp[-1] + 1, slices + 1).astype(np.int64).tolist()
    for during in pairwise(ends):
        check.add(joints, during)
    return list(check.findings())


def test_a_joint_that_follows_gives_no_finding():
    assert findings(stream(), robot()) == []
    assert findings(stream(noise=0.019), robot()) == []  # backlash
    joints = stream()
    joints.position[::2, 3] = np.nan
    assert findings(joints, robot()) == []


def test_another_multiplier_and_offset_are_stated():
    (found,) = findings(stream(2.0, -0.3), robot())
    assert (found.kind, found.severity) == (Kind.FOLLOWER_POSITION, Severity.WARNING)
    assert found.figures["toe/multiplier"] == pytest.approx(2.0)
    assert found.figures["toe/offset"] == pytest.approx(-0.3)
    assert "toe is 2 times knee - 0.3 instead of -2 times knee + 0.1;" in found.message
    # One message more or less in a slice does not matter.
    assert findings(stream(2.0, -0.3), robot(), slices=1)[0].message == found.message


def test_a_joint_that_moves_by_itself_is_no_line():
    joints = stream()
    joints.position[:, 3] = np.sin(3 * TIME)
    (found,) = findings(joints, robot())
    difference = joints.position[:, 3] - (MULTIPLIER * joints.position[:, 1] + OFFSET)
    assert found.figures == {"toe/difference": pytest.approx(np.sqrt(np.mean(difference**2)))}
    assert "toe differs from -2 times knee + 0.1 by" in found.message


@pytest.mark.parametrize(
    ("kind", "size", "error", "is_found"),
    [
        ("revolute", 0.0, 0.019, False),
        ("revolute", 0.0, 0.021, True),
        ("prismatic", 0.0, 0.0009, False),
        ("prismatic", 0.0, 0.0011, True),
        # A tenth of the motion, whose RMS is about 0.7 times the amplitude.
        ("revolute", 0.5, 0.06, False),
        ("revolute", 0.5, 0.08, True),
    ],
)
def test_the_difference_is_judged_by_the_kind_and_the_motion(kind, size, error, is_found):
    found = findings(stream(offset=OFFSET + error, size=size), robot(kind))
    assert [one.kind for one in found] == [Kind.FOLLOWER_POSITION] * is_found


def test_followers_that_the_log_lacks_are_not_judged():
    joints = stream(2.0)
    kept = [0, 1, 2]
    shorter = [one[:, kept] for one in (joints.position, joints.velocity, joints.effort)]
    assert findings(JointStream("/joints", NAMES[:3], joints.stamp, *shorter), robot()) == []


def test_the_effort_of_a_joint_that_follows_another_one_is_reported():
    model = robot()
    (found,) = findings(stream(effort=1.0), model)
    assert (found.kind, found.severity) == (Kind.FOLLOWER_EFFORT, Severity.WARNING)
    assert "publish the effort of knee plus that of toe times -2 as that of knee" in found.message
    # The same sum follows from virtual work.
    force = np.array([[*np.zeros(6), 1.0, 10.0, 3.0, 100.0]])
    model.fold_followers(force)
    assert force[0, 7] == 10.0 - 2.0 * 100.0
    assert findings(stream(effort=0.0), model) == []


def test_efforts_of_several_followers_are_one_finding():
    joints = stream(effort=1.0)
    joints.position[:, 2] = joints.position[:, 3]
    (found,) = findings(joints, robot(followers=2))
    assert found.kind is Kind.FOLLOWER_EFFORT
    assert "effort of foot (follows knee), toe (follows knee) is not used" in found.message
    assert "knee plus that of foot times -2 plus that of toe times -2 as that" in found.message
    assert found.figures == {"foot/multiplier": MULTIPLIER, "toe/multiplier": MULTIPLIER}
