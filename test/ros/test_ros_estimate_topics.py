"""Messages of an estimate against closed forms, with a different number for every axis."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from random_robots import random_robot

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.ros import estimate_topics

STAMP = Time(sec=7, nanosec=8)
LINK = "link_1"
TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
BASE = [f"base/{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz"]


@pytest.fixture(scope="module")
def parameters() -> ParameterSet:
    return ParameterSet(random_robot(1, links=3), ("viscous",))


@pytest.fixture(scope="module")
def estimate(parameters) -> Estimate:
    rng = np.random.default_rng(0)
    count, joints = len(parameters), parameters.model.joint_names
    return Estimate(
        method="map",
        model="random",
        names=tuple(parameters.names),
        units=("",) * count,
        value=parameters.values.copy(),
        prior=parameters.values.copy(),
        std=0.01 * rng.uniform(1.0, 2.0, count),
        determined=np.ones(count, dtype=bool),
        rank=None,
        condition=1.0,
        samples=10,
        residual_rmse={name: 0.5 + place for place, name in enumerate((*BASE, *joints))},
        consistent=dict.fromkeys(parameters.link_names, True),
        inputs=(),
        software="",
    )


def of_link(estimate, values):
    first = estimate.names.index(f"{LINK}/m")
    return values[first : first + 10]


def numbers(message) -> np.ndarray:
    """Return mass, centre of mass and central inertia of a message (10,)."""
    inertia = message.inertia
    com = inertia.com
    return np.array([inertia.m, com.x, com.y, com.z, *(getattr(inertia, name) for name in TENSOR)])


def test_an_inertia_is_about_the_centre_of_mass(estimate) -> None:
    message = estimate_topics.inertia_message(estimate, LINK, STAMP)
    m, mx, my, mz, xx, xy, xz, yy, yz, zz = of_link(estimate, estimate.value)
    about_centre = [
        *(xx - (my**2 + mz**2) / m, xy + mx * my / m, xz + mx * mz / m),
        *(yy - (mx**2 + mz**2) / m, yz + my * mz / m, zz - (mx**2 + my**2) / m),
    ]
    np.testing.assert_allclose(numbers(message), [m, mx / m, my / m, mz / m, *about_centre])
    assert (message.header.frame_id, message.header.stamp) == (LINK, STAMP)


def test_standard_deviations_of_an_inertia_follow_from_its_parameters(estimate) -> None:
    m, mx, my, mz, *_ = of_link(estimate, estimate.value)
    std = of_link(estimate, estimate.std)
    # Derivatives of mass, centre of mass and central inertia by m, mc_x, mc_y and mc_z.
    slopes = np.zeros((10, 10))
    slopes[0, 0] = 1.0
    slopes[1:4, 0] = -np.array([mx, my, mz]) / m**2
    slopes[1:4, 1:4] = np.eye(3) / m
    slopes[4:, :4] = [
        [(my**2 + mz**2) / m**2, 0.0, -2 * my / m, -2 * mz / m],
        [-mx * my / m**2, my / m, mx / m, 0.0],
        [-mx * mz / m**2, mz / m, 0.0, mx / m],
        [(mx**2 + mz**2) / m**2, -2 * mx / m, 0.0, -2 * mz / m],
        [-my * mz / m**2, 0.0, mz / m, my / m],
        [(mx**2 + my**2) / m**2, -2 * mx / m, -2 * my / m, 0.0],
    ]
    slopes[4:, 4:] = np.eye(6)
    expected = np.sqrt(np.sum((slopes * std) ** 2, axis=1))
    assert len(set(np.round(expected, 6))) == 10  # all differ, so that a swapped axis is detected
    message = estimate_topics.inertia_stddev_message(estimate, LINK, STAMP)
    np.testing.assert_allclose(numbers(message), expected, rtol=1e-4)
    assert (message.header.frame_id, message.header.stamp) == (LINK, STAMP)


def test_undetermined_parameters_have_no_standard_deviation(estimate) -> None:
    first = estimate.names.index(f"{LINK}/m")
    determined = estimate.determined.copy()
    determined[[first + 2, first + 6]] = False
    some = estimate_topics.inertia_stddev_message(
        replace(estimate, determined=determined), LINK, STAMP
    )
    assert np.flatnonzero(np.isnan(numbers(some))).tolist() == [2, 6]
    for unknown in ({"std": None}, {"determined": None}):
        none = estimate_topics.inertia_stddev_message(replace(estimate, **unknown), LINK, STAMP)
        assert np.isnan(numbers(none)).all()


def test_residuals_are_published_for_each_joint_and_axis(estimate, parameters) -> None:
    residual = estimate.residual_rmse
    effort = estimate_topics.effort_residual_message(estimate, STAMP)
    assert tuple(effort.name) == parameters.model.joint_names
    assert list(effort.effort) == [residual[name] for name in effort.name]
    assert len(effort.position) == len(effort.velocity) == len(effort.name)
    assert np.isnan([*effort.position, *effort.velocity]).all()
    wrench = estimate_topics.wrench_residual_message(estimate, "link_0", STAMP)
    torque, force = wrench.wrench.torque, wrench.wrench.force
    found = [torque.x, torque.y, torque.z, force.x, force.y, force.z]
    assert found == [residual[name] for name in BASE]
    for message in (effort, wrench):
        assert message.header.stamp == STAMP
    assert wrench.header.frame_id == "link_0"


def test_every_number_has_its_name(estimate, parameters) -> None:
    determined = np.arange(len(parameters)) % 3 > 0
    message = estimate_topics.estimate_message(replace(estimate, determined=determined), STAMP)
    assert message.header.stamp == STAMP
    published = {
        f"{status.name}/{entry.key}": json.loads(entry.value)
        for status in message.status
        for entry in status.values
    }
    expected = {}
    for index, name in enumerate(parameters.names):
        expected[name] = estimate.value[index]
        expected[f"{name}/std"] = estimate.std[index]
        expected[f"{name}/determined"] = bool(determined[index])
    assert published == expected
