"""Bounds by which drives take power, and efforts that contradict them."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_robot

from symbid_ros.dynamics.friction import COULOMB_SPEED, by_kind, coulomb_column, stribeck_column
from symbid_ros.estimation.passive_drives import (
    FASTEST,
    breakaway_bounds,
    contradicts_signs,
    drive_bounds,
    friction_bounds,
)
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.prior import model_prior
from symbid_ros.model.parameters import ParameterSet

TERMS = ("viscous", "coulomb", "armature", "stribeck")
ROBOT = ParameterSet(random_robot(3, 4), TERMS)
sizes = st.floats(0.0, 10.0)


@given(sizes, sizes, sizes, st.floats(0.1, 5.0))
def test_friction_that_takes_power_at_each_speed_is_inside(coulomb, stribeck, slope, speed):
    """Whatever the curve, the bounds accept it if it is positive from rest to the largest speed."""
    columns = ROBOT.term_columns
    values = np.zeros(len(ROBOT))
    fastest = FASTEST * speed
    values[columns["coulomb"]] = coulomb + slope * fastest
    values[columns["viscous"]] = -slope
    values[columns["stribeck"]] = stribeck
    bounds = friction_bounds(ROBOT, np.full(len(ROBOT.joints), speed))
    assert np.all(bounds.matrix @ values >= -1e-9 * np.abs(values).max())


@given(sizes, st.floats(0.01, 10.0), st.floats(0.1, 5.0))
def test_friction_that_gives_power_at_the_largest_speed_is_outside(coulomb, excess, speed):
    columns = ROBOT.term_columns
    values = np.zeros(len(ROBOT))
    values[columns["coulomb"]] = coulomb
    values[columns["viscous"]] = -(coulomb + excess) / (FASTEST * speed)
    bounds = friction_bounds(ROBOT, np.full(len(ROBOT.joints), speed))
    margin = (bounds.matrix @ values).reshape(len(ROBOT.joints), -1)
    np.testing.assert_allclose(margin.min(axis=1), -excess)


@given(sizes, st.floats(-10.0, 10.0))
def test_friction_is_not_negative_when_a_joint_begins_to_slip(coulomb, stribeck):
    values = np.zeros(len(ROBOT))
    values[ROBOT.term_columns["coulomb"]] = coulomb
    values[ROBOT.term_columns["stribeck"]] = stribeck
    joints = [ROBOT.model.joints[joint] for joint in ROBOT.joints]
    slow = by_kind(COULOMB_SPEED, joints)[None]
    friction = coulomb_column(slow, joints) * coulomb + stribeck_column(slow, joints) * stribeck
    bounds = breakaway_bounds(ROBOT)
    np.testing.assert_allclose(bounds.matrix @ values, friction[0], atol=1e-12)
    assert (bounds.lower == 0).all()
    assert (bounds.upper == np.inf).all()


def test_joints_without_stribeck_friction_need_no_such_bound():
    assert not breakaway_bounds(replace(ROBOT, terms=TERMS[:3])).names


def test_a_joint_at_rest_keeps_a_positive_slope():
    bounds = friction_bounds(ROBOT, np.zeros(len(ROBOT.joints)))
    expected = np.eye(len(ROBOT))[ROBOT.term_columns["viscous"]]
    np.testing.assert_array_equal(bounds.matrix, expected)


@pytest.mark.parametrize(
    ("armature", "noise", "contradicts"),
    [(0.0, 0.05, False), (0.5, 0.05, False), (-3.0, 0.05, True), (-1e-4, 1e-7, False)],
    ids=["zero", "positive", "negative", "far below the efforts"],
)
def test_efforts_contradict_positive_signs_if_the_armature_is_negative(
    armature, noise, contradicts
):
    log = gaussian_log(5, links=3, count=200, floating=False, terms=TERMS[:3])
    parameters, truth = log.parameters, log.truth.copy()
    truth[parameters.term_columns["armature"]] = armature
    noise = noise * np.random.default_rng(1).normal(size=log.y.shape)
    observations = replace(log, y=log.K @ truth + noise).observations()
    prior = model_prior(parameters)
    found = posterior(observations, prior.widened(np.full(len(truth), 10.0)))
    assert contradicts_signs(found, parameters, observations) is contradicts
    signs = drive_bounds(parameters, observations)
    dissipation = drive_bounds(replace(parameters, signed_drives=True), observations)
    columns = parameters.term_columns["armature"]
    assert np.any(signs.matrix[:, columns])
    assert not np.any(dissipation.matrix[:, columns])
