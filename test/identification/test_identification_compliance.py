"""Joints that bend under their efforts, with encoders on the motors' side."""

import numpy as np
import pytest
from drive_logs import RATE, arm, drives, log_of, samples_of, slow_waves

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet

SECONDS = 24.0
DEFLECTION = 2e-3  # rad at the root mean square effort
ENCODER = 1e-5  # rad


def elastic_log(robot, compliance, seed=0):
    """Return a log with positions of the motors, and the compliances (J,) of the gears."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, SECONDS, 1 / RATE)
    motion = slow_waves(rng, time, len(robot.joints), 1.2)
    truth = drives(robot, viscous=0.4, coulomb=0.1)
    rows = equation_of_motion(truth, samples_of(robot, time, *motion))
    effort = rows.K @ truth.values - rows.y
    size = np.sqrt(np.mean(effort**2, axis=0))
    measured = effort + 3e-3 * size * rng.normal(size=effort.shape)
    compliance = compliance / size
    position = motion[0] + compliance * effort + ENCODER * rng.normal(size=effort.shape)
    return sy.Log.from_arrays(robot, time=time, position=position, effort=measured), compliance


@pytest.fixture(scope="module")
def robot():
    return arm(seed=5)


@pytest.fixture(scope="module")
def elastic(robot):
    return elastic_log(robot, DEFLECTION)


@pytest.fixture(scope="module")
def found(robot, elastic):
    return sy.identify(robot, elastic[0], unchecked=True, no_holdout=True)


def errors_of_determined(result, robot):
    """Return the errors of determined parameters of links, in standard deviations."""
    parameters = ParameterSet(robot)
    true = dict(zip(parameters.names, parameters.values, strict=True))
    some = [(result.parameters[name], value) for name, value in true.items()]
    return np.array([(one.value - value) / one.std for one, value in some if one.is_determined])


def test_compliance_is_found(robot, elastic, found):
    sensors = {one.name: one for one in found.estimate.verdict.sensors}
    for name, value in zip(robot.joint_names, elastic[1], strict=True):
        one = sensors[f"{name}/compliance"]
        assert one.unit == "rad/Nm"
        assert abs(one.value - value) < max(4 * one.std, 0.1 * value)


def test_the_links_are_right_only_with_compliance(robot, elastic):
    parameters = ParameterSet(robot)
    file = parameters.apply(draw_prior(parameters, "consistent", 20, 1).mean)
    log, options = elastic[0], {"unchecked": True, "no_holdout": True}
    found = sy.identify(file, log, **options)
    rigid = sy.identify(file, log, sensor_errors="none", **options)
    assert found.estimate.verdict.sensors
    assert not rigid.estimate.verdict.sensors
    bent, wrong = (np.mean(errors_of_determined(one, robot) ** 2) for one in (found, rigid))
    assert bent < 2.0
    assert wrong > 5.0


def test_rigid_joints_have_no_compliance(robot):
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    result = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert not result.estimate.verdict.sensors


def test_a_saved_result_predicts_with_its_compliance(tmp_path, robot, elastic):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(robot))
    robot = sy.load_model(path, base="fixed")
    found = sy.identify(
        robot, elastic[0], unchecked=True, no_holdout=True, sensor_errors="compliance"
    )
    found.save(tmp_path / "result")
    predictor = ForcePredictor.load(tmp_path / "result")
    assert predictor.sensor_names == tuple(f"{name}/compliance" for name in robot.joint_names)
    held_out, _ = elastic_log(robot, DEFLECTION, seed=1)
    assert sy.validate(tmp_path / "result", held_out).percent_after < 1.0
