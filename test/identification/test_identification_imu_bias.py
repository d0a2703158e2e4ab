"""Biases of the IMU of a robot with foot sensors, which the log shows."""

import numpy as np
import pytest
from quadruped_log import FEET, inaccurate, load_quadruped, standing_log

from symbid_ros.estimation.archive import load_archive
from symbid_ros.identification.api import identify
from symbid_ros.identification.loaded_problem import load_information
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log

BIAS = np.array([0.003, -0.002, 0.001, 0.03, -0.04, 0.02])  # rad/s, m/s²
NAMES = [
    f"imu_link/imu_bias_{one}_{axis}" for one in ("gyroscope", "accelerometer") for axis in "xyz"
]
OPTIONS = {"joint_terms": "none", "no_holdout": True}


@pytest.fixture(scope="module")
def true_robot(tmp_path_factory):
    return load_quadruped(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def robot(true_robot):
    return inaccurate(true_robot)


@pytest.fixture(scope="module")
def readings(true_robot):
    return standing_log(true_robot, 12.0, 3, friction=0.0)


def log_of(robot, readings, bias):
    joints, imu = readings["/joint_states"], readings["/imu"]
    return Log.from_arrays(
        robot,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"],
        imus={"imu_link": np.hstack([imu["angular_velocity"], imu["linear_acceleration"]]) + bias},
        wrenches={foot: readings[f"/{foot}/wrench"]["wrench"] for foot in FEET},
    )


def square(estimate, true_robot):
    """Return the mean square of errors of determined parameters, in standard deviations."""
    truth = true_robot.inertial_parameters
    known = estimate.determined[: len(truth)]
    errors = (estimate.value - truth) / estimate.std
    return float(np.mean(errors[known] ** 2))


def test_biases_are_identified_if_the_log_shows_them(robot, true_robot, readings):
    log = log_of(robot, readings, BIAS)
    found, exact = (
        identify(robot, log, **OPTIONS, sensor_errors=errors).estimate for errors in ((), "none")
    )
    assert not found.verdict.alarms
    biases = {one.name: one for one in found.verdict.sensors}
    assert list(biases) == NAMES
    for name, bias in zip(NAMES, BIAS, strict=True):
        assert abs(biases[name].value - bias) < 4 * biases[name].std
    assert biases[NAMES[3]].std < 0.002
    assert square(found, true_robot) < 1.6
    assert found.verdict.whiteness < 0.5 * exact.verdict.whiteness


def test_information_is_that_of_an_imu_without_biases(robot, true_robot, readings, tmp_path):
    """Other logs have other biases, so information of several contains none."""
    options = IdentifyOptions(**OPTIONS | {"joint_terms": ("none",)})
    saved = {}
    for name, bias in (("biased", BIAS), ("exact", np.zeros(6))):
        identify(robot, log_of(robot, readings, bias), **OPTIONS).save(tmp_path / name)
        information = load_archive(tmp_path / name / "information.npz")
        assert information[0].layout.parameters == ParameterSet(robot).names
        saved[name] = load_information(robot, information, options).solve().estimate
    assert not any(one.verdict.sensors for one in saved.values())
    assert square(saved["biased"], true_robot) < 2.0
    distance = (saved["biased"].value - saved["exact"].value) / saved["exact"].std
    assert np.sqrt(np.mean(distance**2)) < 0.5


def test_an_imu_without_biases_keeps_its_readings(robot, readings):
    found = identify(robot, log_of(robot, readings, np.zeros(6)), **OPTIONS).estimate
    assert not found.verdict.sensors


def test_a_wrong_foot_sensor_is_not_taken_for_a_bias(robot, readings):
    """A bias would explain a part of its offset only."""
    wrench = readings["/LF_foot/wrench"]["wrench"] + np.array([0, 0, 0, 6.0, 0, 0])
    wrong = readings | {"/LF_foot/wrench": {"wrench": wrench}}
    found = identify(robot, log_of(robot, wrong, np.zeros(6)), **OPTIONS)
    assert not found.estimate.verdict.sensors
    assert any("LF_foot" in one for one in found.alarms)
