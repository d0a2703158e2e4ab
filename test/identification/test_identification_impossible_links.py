"""A model file with a link that no body can be is identified as one that can."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.model.inertia import is_consistent, phi_from_com

BAD = 2


@pytest.fixture(scope="module")
def robot():
    return arm()


@pytest.fixture(scope="module")
def stated(robot):
    """The robot with a link whose largest moment exceeds the sum of the others."""
    phi = robot.phi.copy()
    mass, com = phi[BAD, 0], phi[BAD, 1:4] / phi[BAD, 0]
    phi[BAD] = phi_from_com(mass, com, 0.01 * mass * np.diag([3.0, 1.0, 1.0]))
    assert not is_consistent(phi[BAD])
    return robot.with_phi(phi)


def test_the_link_is_named_once_and_its_estimate_is_possible(robot, stated, caplog):
    name = stated.link_names[BAD]
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    estimate = sy.identify(stated, log, no_holdout=True).estimate
    named = [one for one in caplog.messages if "physically impossible" in one]
    assert len(named) == 1
    assert f"link {name} is" in named[0]
    assert estimate.consistent[name]
