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
