"""Springs beside the drives: stated by the model file, or found in a log."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import unwritten
from symbid_ros.model.parameters import ParameterSet

STIFFNESS, RELAXED = np.array([0.0, 3.0, 0.0]), 0.4  # Nm/rad, rad


def springs(position):
    """Return the torques (N, J) that joints need against their springs."""
    return STIFFNESS * (position - RELAXED)


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), by_angle=springs)


def is_right(result, joint, term, value):
    one = result.parameters[f"{joint}/{term}"]
    assert one.is_determined
    assert abs(one.value - value) < max(4 * one.std, 0.02)


def test_a_spring_is_found(robot, log, caplog):
    found = sy.identify(robot, log, unchecked=True)
    joint = robot.joint_names[1]
    is_right(found, joint, "stiffness", STIFFNESS[1])
    is_right(found, joint, "offset", -STIFFNESS[1] * RELAXED)
    assert found.parameters[f"{joint}/stiffness"].unit == "Nm/rad"
    assert found.estimate.holdout.percent_after < 1.0
    assert f"springs act on {joint}, and" in caplog.text
    # The model has the stiffness; where the spring is relaxed remains an offset of the estimate.
    assert found.robot.joints[1].stiffness == pytest.approx(STIFFNESS[1], rel=0.05)
    assert any("stiffness, not part of a URDF" in line for line in unwritten(found.robot))
    # The other joints have none.
    others = set(robot.joint_names) - {joint}
    assert {found.parameters[f"{one}/stiffness"].value for one in others} == {0.0}


def test_no_spring_is_found_where_there_is_none(robot):
    plain = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    found = sy.identify(robot, plain, unchecked=True, no_holdout=True)
    assert not any(name.endswith("/stiffness") for name in found.estimate.names)


def sprung(robot, stiffness):
    joints = tuple(
        replace(joint, stiffness=float(one), spring_reference=RELAXED)
        for joint, one in zip(robot.joints, stiffness, strict=True)
    )
    return replace(robot, joints=joints)


def test_a_stated_spring_is_a_candidate_and_else_a_known_torque(robot, log):
    stated = sprung(robot, 1.3 * STIFFNESS)  # as wrong as other numbers of files
    found = sy.identify(stated, log, unchecked=True, no_holdout=True)
    is_right(found, robot.joint_names[1], "stiffness", STIFFNESS[1])
    terms = ("viscous,coulomb,armature",)
    known = sy.identify(
        sprung(robot, STIFFNESS), log, unchecked=True, no_holdout=True, joint_terms=terms
    )
    unknown = sy.identify(robot, log, unchecked=True, no_holdout=True, joint_terms=terms)
    assert known.estimate.verdict.whiteness < 0.7 * unknown.estimate.verdict.whiteness


def test_mujoco_has_the_same_spring(robot, tmp_path):
    """The written model, in MuJoCo and read again."""
    stated = sprung(robot, STIFFNESS)
    path = tmp_path / "robot.xml"
    path.write_text(mjcf_text(stated))
    again = sy.load_model(path)
    for one, other in zip(again.joints, stated.joints, strict=True):
        assert one.stiffness == other.stiffness
        assert one.spring_reference == (other.spring_reference if other.stiffness else 0)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (6, model.nq))
    torque = []
    for position in q:
        data.qpos[:] = position
        mujoco.mj_inverse(model, data)
        torque.append(data.qfrc_inverse.copy())
    none, base = np.zeros_like(q), np.zeros((6, 3))
    wrenches = np.zeros((6, 0, 6))
    upwards = np.tile(-again.gravity, (6, 1))
    still = Samples(np.arange(6), q, none, none, none, base, base, upwards, wrenches, ())
    for terms in ((), ("stiffness",)):
        parameters = ParameterSet(again, terms)
        rows = equation_of_motion(parameters, still)
        needed = rows.K @ parameters.values - rows.y
        np.testing.assert_allclose(needed, torque, atol=1e-9)
