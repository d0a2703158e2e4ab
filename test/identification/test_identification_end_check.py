"""Trials that the end of a log decides: comparable errors, and drives of either sign."""

import numpy as np
import pytest
from drive_logs import RATE, SECONDS, arm, drives, log_of

import symbid_ros as sy
from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.end_check import EndCheck, percents
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.holdout import hold_out
from symbid_ros.signals.weak_form import WINDOWS

FRICTION = {"viscous": 0.4, "coulomb": 0.8}
CROSSTALK = 2.0  # Nm s²/rad, more than the inertia of any joint


def test_errors_are_compared_over_equal_windows():
    """An average over a longer window contains less noise, whatever the estimate."""
    robot = arm()
    problem = load_problem(robot, log_of(robot, drives(robot, **FRICTION)), IdentifyOptions())
    short, long = (hold_out(problem, window, 0) for window in (WINDOWS[0], WINDOWS[-1]))
    assert short.holdout.percent_after > 1.3 * long.holdout.percent_after
    one, other = percents(short, long)
    assert other == long.holdout.percent_after
    assert one == pytest.approx(other, rel=0.1)
    assert percents(long, short) == (other, one)
    assert percents(short, short) == (short.holdout.percent_after,) * 2


def test_a_check_without_an_end_is_not_compared():
    robot = arm()
    log = log_of(robot, drives(robot, **FRICTION), seconds=8.0)
    problem = load_problem(robot, log, IdentifyOptions())
    check = hold_out(problem, problem.solve().window, 0)
    found = sy.identify(robot, log, no_holdout=True).estimate
    assert found.holdout is None
    nothing = EndCheck(HoldOut(0.0, None, None, "none", 0.0, {}, "too short"))
    assert percents(nothing, check) is None


def crosstalk(until):
    """Return torques by which the efforts show less inertia than any link has, up to an instant."""

    def extra(velocity, acceleration):
        time = np.arange(len(acceleration)) / RATE
        return np.where(time < until, -CROSSTALK, 0.0)[:, None] * acceleration

    return extra


def remarks_of(result, kind):
    return [
        one for one in result.estimate.remarks if f"viscous friction {kind} in this result" in one
    ]


def test_efforts_without_inertia_that_last_have_negative_armatures():
    robot = arm()
    log = log_of(robot, drives(robot, **FRICTION), extra=crosstalk(np.inf))
    found = sy.identify(robot, log, unchecked=True)
    armatures = [found.parameters[f"{joint}/armature"].value for joint in robot.joint_names[1:]]
    # Links take up part of it.
    np.testing.assert_allclose(armatures, -CROSSTALK, rtol=0.2)
    assert found.estimate.holdout.percent_after < 2.0
    assert remarks_of(found, "may be negative")
    kept = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert min(one.value for one in kept.parameters.values() if "armature" in one.name) >= 0
    assert remarks_of(kept, "are positive")
    asked = sy.identify(robot, log, unchecked=True, no_holdout=True, signed_drives=True)
    np.testing.assert_allclose(asked.estimate.value, found.estimate.value, rtol=1e-6, atol=1e-9)


def test_efforts_without_inertia_that_end_keep_positive_armatures():
    """Negative ones would explain the first part of the log, and mislead in its end."""
    robot = arm()
    log = log_of(robot, drives(robot, **FRICTION), extra=crosstalk(0.7 * SECONDS))
    found = sy.identify(robot, log, unchecked=True)
    assert min(one.value for one in found.parameters.values() if "armature" in one.name) >= 0
    assert remarks_of(found, "are positive")
