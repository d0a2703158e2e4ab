"""Efforts measured behind the gear, which contain no armature."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.errors import OptionError


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


@pytest.fixture(scope="module")
def geared(robot):
    """The robot, whose file states armatures."""
    return replace(robot, joints=tuple(replace(one, armature=0.4) for one in robot.joints))


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot, drives(robot, viscous=0.4))


def links_are_right(result, robot):
    for name, link in result.links.items():
        true = robot.links[robot.link_names.index(name)].phi[0]
        if result.parameters[f"{name}/m"].is_determined:
            assert link.mass == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("terms", [(), ("viscous",)])
def test_an_armature_of_the_model_file_does_not_act_on_link_side_efforts(robot, geared, log, terms):
    fields = {"joint_terms": terms} if terms else {}
    link = sy.identify(geared, log, unchecked=True, effort_side="link", **fields)
    assert link.estimate.holdout.percent_after < 1.0
    assert not any("armature" in one for one in (link.estimate.joint_terms or {}).values())
    links_are_right(link, robot)
    assert [joint.armature for joint in link.robot.joints] == [0.4] * len(robot.joints)
    motor = sy.identify(geared, log, unchecked=True, effort_side="motor", joint_terms=("viscous",))
    assert motor.estimate.holdout.percent_after > 2 * link.estimate.holdout.percent_after


def test_sides_are_given_by_joint(robot):
    first, *_, last = robot.joint_names
    log = log_of(
        robot,
        drives(robot, armature=0.4),
        extra=lambda _, acceleration: -0.4 * acceleration * np.array([0, 0, 1]),
    )
    result = sy.identify(robot, log, unchecked=True, effort_side=f"{last}=link", no_holdout=True)
    assert "armature" not in result.estimate.joint_terms[last]
    assert "armature" in result.estimate.joint_terms[first]


@pytest.mark.parametrize("text", ["gear", "joint_1=", "link,motor", "elbow=link"])
def test_invalid_sides_are_refused(robot, log, text):
    with pytest.raises(OptionError, match="effort_side"):
        sy.identify(robot, log, effort_side=text)


def test_named_armature_contradicts_efforts_of_links():
    with pytest.raises(OptionError, match="no armature"):
        sy.IdentifyOptions(effort_side="link", armature=True)
