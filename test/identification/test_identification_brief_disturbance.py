"""A brief contact that no sensor measures, among seconds that the robot's model explains."""

import re

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy

SECONDS, PUSH = 30.0, np.array([12.0, -9.0, 6.0])  # Nm


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


def pushed(robot, start, stop):
    """Return a log in which something pushes from ``start`` to ``stop``, s."""
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    joints = log_of(robot, truth, seconds=SECONDS).streams().joints
    time = (joints.stamp - joints.stamp[0]) * 1e-9
    is_pushed = (time >= start) & (time < stop)
    effort = joints.effort + is_pushed[:, None] * PUSH * np.sin(2 * time)[:, None] ** 2
    return sy.Log.from_arrays(robot, time=time, position=joints.position, effort=effort)


def disturbances(robot, start, stop):
    found = sy.identify(robot, pushed(robot, start, stop), no_holdout=True)
    return [one for one in found.alarms if "a contact or a collision" in one], found.alarms


@pytest.mark.parametrize(
    ("start", "stop", "advice"),
    [
        (0.0, 3.0, r"leave out these first (\d+) s with `start`"),
        (12.0, 15.0, "identify the part before or after it alone, with `stop` or `start`"),
        (27.0, SECONDS, r"leave out these last (\d+) s with `stop`"),
    ],
)
def test_a_brief_contact_is_named_first(robot, start, stop, advice) -> None:
    named, alarms = disturbances(robot, start, stop)
    assert named == [alarms[0]]
    said = re.search(r"from (\d+) to (\d+) s of the log", alarms[0])
    assert said is not None
    # Windows at its borders contain a part of it.
    assert 0 <= start - float(said[1]) <= 1
    assert 0 <= float(said[2]) - stop <= 1
    found = re.search(advice, alarms[0])
    assert found is not None
    assert all(float(one) == float(said[2]) - float(said[1]) for one in found.groups())


@pytest.mark.parametrize("stop", [0.0, SECONDS])
def test_right_efforts_and_a_lasting_push_are_no_brief_contact(robot, stop) -> None:
    assert not disturbances(robot, 0.0, stop)[0]
