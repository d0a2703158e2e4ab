"""Torques that repeat in a turn of a joint, named and found."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import NOISE, RATE, SECONDS, arm, drives, log_of, samples_of

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import ModelError
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.ripple import Ripple

JOINT, PERIODS = 1, 5
SINE, COSINE = 0.7, -0.4  # Nm


def ripple(position):
    """Return the torques (N, J) of a torque sensor with five spokes."""
    torque = np.zeros_like(position)
    angle = PERIODS * position[:, JOINT]
    torque[:, JOINT] = SINE * np.sin(angle) + COSINE * np.cos(angle)
    return torque


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), by_angle=ripple)


@pytest.fixture(scope="module")
def found(robot, log):
    return sy.identify(robot, log, unchecked=True)


def is_right(result, joint):
    for name, value in (("sin", SINE), ("cos", COSINE)):
        one = result.parameters[f"{joint}/ripple{PERIODS}_{name}"]
        assert one.is_determined
        assert one.unit == "Nm"
        assert abs(one.value - value) < max(4 * one.std, 0.02)


def test_a_ripple_is_found(robot, found):
    is_right(found, robot.joint_names[JOINT])
    assert f"{robot.joint_names[JOINT]}: {PERIODS}" in found.estimate.describe_terms()
    assert found.estimate.holdout.percent_after < 1.0


def sweeps(robot, count):
    """Return a log in which the joint with the ripple passes over its range ``count`` times."""
    time = np.arange(0.0, SECONDS, 1 / RATE)
    passes = np.arange(7.0, 7.0 + len(robot.joints))
    passes[JOINT] = count
    rate = passes * np.pi / SECONDS
    angle = rate * time[:, None]
    motion = -2 * np.cos(angle), 2 * rate * np.sin(angle), 2 * rate**2 * np.cos(angle)
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    rows = equation_of_motion(truth, samples_of(robot, time, *motion))
    effort = rows.K @ truth.values - rows.y + ripple(motion[0])
    effort += NOISE * effort.std(axis=0) * np.random.default_rng(0).normal(size=effort.shape)
    return sy.Log.from_arrays(robot, time=time, position=motion[0], effort=effort)


@pytest.mark.parametrize(("count", "expected"), [(2, ()), (6, (Ripple(JOINT, PERIODS),))])
def test_a_ripple_is_searched_for_if_angles_come_back(robot, count, expected):
    found = sy.identify(robot, sweeps(robot, count), unchecked=True, no_holdout=True)
    assert ParameterSet.of_names(robot, found.estimate.names).ripples == expected


def test_the_links_are_as_with_a_log_without_the_ripple(robot, found):
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    plain = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert not ParameterSet.of_names(robot, plain.estimate.names).ripples
    names = [name for name, one in plain.parameters.items() if one.is_determined]
    both = [(plain.parameters[name], found.parameters[name]) for name in names]
    assert np.mean([abs(a.value - b.value) < 4 * np.hypot(a.std, b.std) for a, b in both]) > 0.95


def test_a_saved_result_has_its_ripple(tmp_path, robot, log):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(robot))
    robot = sy.load_model(path, base="fixed")
    label = f"{robot.joint_names[JOINT]}:{PERIODS}"
    found = sy.identify(robot, log, unchecked=True, no_holdout=True, ripple=label)
    is_right(found, robot.joint_names[JOINT])
    found.save(tmp_path / "result")
    predictor = ForcePredictor.load(tmp_path / "result")
    assert predictor.parameters.ripples == (Ripple(JOINT, PERIODS),)
    again = sy.identify(robot, sy.LogInformation.load(tmp_path / "result/information.npz"))
    assert again.estimate.joint_terms == found.estimate.joint_terms
    np.testing.assert_allclose(again.estimate.value, found.estimate.value, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("text", ["{0}", "{0}:1", "{0}:-4", "{0}:four", "elbow:4", ""])
def test_invalid_ripples_are_refused(robot, text):
    with pytest.raises(ModelError, match="ripple") as refusal:
        Ripple.parse(text.format(*robot.joint_names), robot)
    assert refusal.value.code == "E900"
    assert Ripple.parse(f"{robot.joint_names[JOINT]}:{PERIODS}", robot) == Ripple(JOINT, PERIODS)


@pytest.mark.parametrize("seed", [2, 5, 12])
def test_a_stated_prior_that_the_data_contradict_shows_no_further_terms(seed, caplog):
    """The residuals of links that are held at wrong values resemble ripples, springs and others."""
    true = arm(seed=seed)
    draw = np.random.default_rng(seed)
    scales = np.concatenate([draw.uniform(0.7, 1.3, (len(true.links), 4)), np.ones((4, 6))], axis=1)
    wrong = replace(
        true,
        links=tuple(
            replace(one, phi=one.phi * scale) for one, scale in zip(true.links, scales, strict=True)
        ),
    )
    log = log_of(true, drives(true))
    found = sy.identify(wrong, log, prior_percent=1, unchecked=True, no_holdout=True)
    assert any(one.startswith("the data contradict the prior") for one in found.alarms)
    assert not [one for one in found.parameters if "ripple" in one or "stiffness" in one]
    assert found.estimate.verdict.sensors == ()
    assert "identified as well" not in caplog.text


def test_a_ripple_is_found_beside_a_stated_prior_that_the_data_contradict(robot, log):
    wrong = replace(robot, links=tuple(replace(one, phi=1.3 * one.phi) for one in robot.links))
    found = sy.identify(wrong, log, prior_percent=1, unchecked=True, no_holdout=True)
    assert any(one.startswith("the data contradict the prior") for one in found.alarms)
    assert ParameterSet.of_names(robot, found.estimate.names).ripples == (Ripple(JOINT, PERIODS),)
