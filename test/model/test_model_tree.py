"""The tree of links: unique names and default limits."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.errors import ModelError
from symbid_ros.model.tree import Joint


@pytest.mark.parametrize(("kind", "several"), [("link", "links"), ("joint", "joints")])
def test_duplicate_names_are_rejected(kind, several) -> None:
    robot = random_robot(0, links=4)
    first, *others, last = getattr(robot, several)
    names = (first, *others, replace(last, name=others[0].name))
    with pytest.raises(ModelError, match=f"^random: {kind} name '{others[0].name}' is used twice"):
        replace(robot, **{several: names})


def test_a_joint_has_no_limits_unless_they_are_given() -> None:
    joint = Joint("hinge", "revolute", 0, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert (joint.lower, joint.upper, joint.effort) == (-np.inf, np.inf, np.inf)


@pytest.mark.parametrize("floating", [True, False])
def test_coordinates_are_the_bases_moment_and_force_and_the_joints(floating) -> None:
    robot = random_robot(0, links=4, floating=floating)
    base = [f"base/{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz"]
    assert robot.coordinates == (*(base if floating else []), "joint_0", "joint_1", "joint_2")
    assert robot.dof == len(robot.coordinates)


@pytest.mark.parametrize("seed", range(3))
def test_ancestors_are_the_joints_on_the_way_to_the_base(seed) -> None:
    robot = random_robot(seed, links=7)
    for link in range(7):
        path, at = set(), link
        while at:
            path.add(at - 1)
            at = robot.joints[at - 1].parent
        assert set(np.flatnonzero(robot.ancestors[:, link]).tolist()) == path


def test_frames_are_found_by_name_and_links_are_frames_of_their_own() -> None:
    robot = random_robot(1, links=4)
    for frame in robot.frames:
        assert robot.frame(frame.name) is frame
    own = robot.frame("link_2")
    assert own.link == 2
    np.testing.assert_array_equal(own.rotation, np.eye(3))
    np.testing.assert_array_equal(own.translation, np.zeros(3))
    with pytest.raises(ModelError, match=r"no frame or link 'hand'.*imu_link.*link_3"):
        robot.frame("hand")
