"""The tree itself: names are unique, whoever builds it."""

from dataclasses import replace

import pytest
from random_robots import random_robot

from symbid_ros.errors import ModelError


@pytest.mark.parametrize(("kind", "several"), [("link", "links"), ("joint", "joints")])
def test_a_name_used_twice_is_refused_and_named(kind, several) -> None:
    robot = random_robot(0, links=4)
    first, *others, last = getattr(robot, several)
    names = (first, *others, replace(last, name=others[0].name))
    with pytest.raises(ModelError, match=f"^random: {kind} name '{others[0].name}' is used twice"):
        replace(robot, **{several: names})
