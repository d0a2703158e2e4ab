"""Coulomb friction in proportion to the load of a joint."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.export_urdf import urdf_text

SHARE = 0.08


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "robot.urdf"
    path.write_text(urdf_text(arm(seed=2)))
    return sy.load_model(path, base="fixed")


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot, drives(robot), load=SHARE)


def test_friction_that_grows_with_the_load_is_found(robot, log):
    result = sy.identify(robot, log, unchecked=True)
    for joint in robot.joint_names:
        found = result.parameters[f"{joint}/load"]
        assert found.is_determined
        assert found.value == pytest.approx(SHARE, abs=max(5 * found.std, 2e-3))
    assert result.estimate.holdout.percent_after < 1.0


def test_a_saved_result_keeps_the_reference_of_the_load(tmp_path, robot, log):
    heavier = robot.with_phi(1.2 * robot.phi)
    result = sy.identify(heavier, log, unchecked=True, no_holdout=True)
    result.save(tmp_path)
    predictor = ForcePredictor.load(tmp_path)
    # The identified links differ from the original ones, whose load the friction refers to.
    np.testing.assert_allclose(predictor.parameters.load_reference, heavier.phi.ravel())
    for joint in robot.joint_names:
        assert result.parameters[f"{joint}/load"].value == pytest.approx(SHARE / 1.2, rel=0.05)


def test_without_load_friction_none_is_found(robot):
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    result = sy.identify(robot, log_of(robot, truth), unchecked=True, no_holdout=True)
    size = [result.parameters[name].value for name in result.parameters if name.endswith("/load")]
    assert np.all(np.abs(size) < 2e-3)
