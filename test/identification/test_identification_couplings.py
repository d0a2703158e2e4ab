"""Drives that turn with two joints, named and found."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.errors import ModelError, OptionError
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.export_urdf import urdf_text

VISCOUS, COULOMB, ARMATURE = 0.6, 1.5, 0.05
RATIO = -1.0
DRIVE = np.array([0.0, 1.0, RATIO])


def coupled(velocity, acceleration):
    """Return the torques (N, 3) of a motor that turns with the last two joints."""
    speed = velocity @ DRIVE
    torque = VISCOUS * speed + COULOMB * np.sign(speed) + ARMATURE * (acceleration @ DRIVE)
    return torque[:, None] * DRIVE


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


@pytest.fixture(scope="module")
def label(robot):
    return f"{robot.joint_names[1]}-{robot.joint_names[2]}"


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), extra=coupled)


@pytest.fixture(scope="module")
def found(robot, log):
    return sy.identify(robot, log, unchecked=True)


def is_right(result, label):
    for term, value in (("viscous", VISCOUS), ("coulomb", COULOMB), ("armature", ARMATURE)):
        one = result.parameters[f"{label}/{term}"]
        assert one.is_determined
        assert abs(one.value - value) < max(4 * one.std, 0.03 * value)


def test_a_coupling_is_found(found, label):
    is_right(found, label)
    assert set(found.estimate.joint_terms[label]) >= {"viscous", "coulomb", "armature"}
    assert label in found.estimate.describe_terms()
    assert found.estimate.holdout.percent_after < 1.0


def test_a_shared_drive_with_friction_of_another_shape_is_found(robot, label):
    """Friction that grows with the square of the speed: Coulomb friction would be negative."""

    def quadratic(velocity, acceleration):
        speed = velocity @ DRIVE
        return (VISCOUS * speed * np.abs(speed))[:, None] * DRIVE

    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), extra=quadratic)
    found = sy.identify(robot, log, unchecked=True)
    assert "viscous" in found.estimate.joint_terms[label]
    assert "coulomb" not in found.estimate.joint_terms[label]
    assert found.estimate.holdout.percent_after < 5.0


def test_a_shared_drive_with_a_rotor_and_without_friction_is_found(robot, label):
    def rotor(velocity, acceleration):
        return ARMATURE * (acceleration @ DRIVE)[:, None] * DRIVE

    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), extra=rotor)
    found = sy.identify(robot, log, unchecked=True)
    assert found.estimate.joint_terms[label] == ("armature",)
    one = found.parameters[f"{label}/armature"]
    assert abs(one.value - ARMATURE) < max(4 * one.std, 0.02 * ARMATURE)
    assert not found.alarms


def test_a_named_coupling_is_identified(robot, log, label):
    result = sy.identify(robot, log, unchecked=True, no_holdout=True, coupling=label)
    is_right(result, label)


def test_without_a_coupling_none_is_found(robot, label):
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    result = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert not any("+" in name or "-" in name for name in result.estimate.joint_terms)


def test_a_saved_result_has_its_coupling(tmp_path, robot, log, label):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(robot))
    robot = sy.load_model(path, base="fixed")
    found = sy.identify(robot, log, unchecked=True, no_holdout=True, coupling=label)
    found.save(tmp_path / "result")
    predictor = ForcePredictor.load(tmp_path / "result")
    assert [one.label for one in predictor.parameters.couplings] == [label]
    again = sy.identify(robot, sy.LogInformation.load(tmp_path / "result/information.npz"))
    assert again.estimate.joint_terms == found.estimate.joint_terms
    np.testing.assert_allclose(again.estimate.value, found.estimate.value, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "joints", "ratios"),
    [
        ("{1}+{2}", (1, 2), (1.0, 1.0)),
        ("{0} - 0.5*{2}", (0, 2), (1.0, -0.5)),
        ("2*{0}+{1}-{2}", (0, 1, 2), (1.0, 0.5, -0.5)),
    ],
)
def test_labels_are_sums_of_joints(robot, text, joints, ratios):
    coupling = Coupling.parse(text.format(*robot.joint_names), robot)
    assert (coupling.joints, coupling.ratios) == (joints, ratios)
    assert Coupling.parse(coupling.label, robot) == coupling


@pytest.mark.parametrize("text", ["{0}", "{0}+{0}", "{0}+elbow", "{0}+0*{1}", "", "{0}{1}"])
def test_invalid_couplings_are_refused(robot, text):
    with pytest.raises(ModelError, match="coupling") as refusal:
        Coupling.parse(text.format(*robot.joint_names), robot)
    assert refusal.value.code == "E118"


def test_a_coupling_needs_terms():
    with pytest.raises(OptionError, match="coupling"):
        sy.IdentifyOptions(coupling=("a+b",), joint_terms=("none",))


@pytest.mark.parametrize("seed", [0, 3, 5, 6])
def test_a_coupling_is_found_in_a_log_too_short_for_a_test_of_residuals(robot, label, seed):
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), seed, extra=coupled, seconds=3.4)
    found = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert label in found.estimate.joint_terms


@pytest.mark.parametrize("seconds", [3.0, 5.0])
def test_no_coupling_is_found_in_a_short_log_without_one(robot, seconds):
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), seconds=seconds)
    found = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert list(found.estimate.joint_terms) == list(robot.joint_names)
