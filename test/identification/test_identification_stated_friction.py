"""Friction and armature that a model file states are part of the equation of motion."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from tree_simulation import TreeSimulation

from symbid_ros.dynamics.friction import is_slipping
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import evaluate, predict, sticking_share
from symbid_ros.identification.predictions.realistic_prediction import (
    RealisticMotion,
    predict_realistic,
)
from symbid_ros.identification.result_files import load_estimated_model, write_identification
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.frames import Frame
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.simulation.recording import record

Z1 = (
    Path(pinocchio.__file__).parents[4]
    / "share/example-robot-data/robots/z1_description/urdf/z1.urdf"
)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """URDFs of a real arm with and without friction, and two logs of the arm with friction."""
    folder = tmp_path_factory.mktemp("arm")
    robot = load_model(Z1, "fixed")
    assert all(joint.damping > 0 and joint.friction_loss > 0 for joint in robot.joints)
    robot = replace(robot, frames=(Frame("imu_link", 0, np.eye(3), np.zeros(3)),))
    (folder / "robot.urdf").write_text(urdf_text(robot))
    smooth = tuple(replace(joint, damping=0.0, friction_loss=0.0) for joint in robot.joints)
    (folder / "smooth.urdf").write_text(urdf_text(replace(robot, joints=smooth)))
    record(TreeSimulation(robot, 2.6, 1), folder / "log")
    record(TreeSimulation(robot, 0.8, 2), folder / "other")
    return folder


def torque_of_exported(model, folder, motion):
    """Return the validation torques as MuJoCo computes them from the written model.xml."""
    compiled = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(compiled)
    torques = []
    for position, velocity, acceleration in zip(
        motion.samples.position, motion.samples.velocity, motion.samples.acceleration, strict=True
    ):
        data.qpos[:], data.qvel[:], data.qacc[:] = position, velocity, acceleration
        mujoco.mj_inverse(compiled, data)
        rubbing = compiled.dof_frictionloss * np.clip(velocity / 1e-3, -1, 1)
        torques.append(data.qfrc_inverse + rubbing)
    return np.array(torques)


def test_the_truth_errs_by_nothing_because_sticking_joints_do_not_count(arm) -> None:
    robot = load_model(arm / "robot.urdf", "fixed")
    motion = read_true_motion([arm / "other"], robot)
    parameters = ParameterSet(robot, ("viscous", "coulomb"))
    truth = parameters.values
    true = motion.samples.effort
    sticks = ~is_slipping(motion.samples.velocity, robot.joints)
    assert sticking_share(parameters, truth, motion) == pytest.approx(sticks.mean())
    assert 0 < sticks.mean() < 0.5
    metrics = evaluate(parameters, {"it": truth}, truth, motion)["it"]
    every = rms(predict(parameters, truth, motion).gen_force - true)
    assert metrics.torque_rmse < 0.2 * every
    # Without friction, a joint at rest obeys the equation as well.
    smooth = ParameterSet(load_model(arm / "smooth.urdf", "fixed"), ("viscous", "coulomb"))
    assert sticking_share(smooth, smooth.values, motion) == 0


def rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=1)))


@pytest.mark.parametrize(
    ("rows", "most"), [({}, 0.01), ({"filter": "savitzky_golay", "window": 0.011}, 0.03)], ids=str
)
def test_friction_of_the_model_file_is_used_and_kept(arm, rows, most, tmp_path, caplog):
    options = IdentifyOptions(joint_terms=("none",), **rows)
    prepared = BagRequest((arm / "log",), arm / "robot.urdf", options, base="fixed").load()
    assert "states viscous friction of joint1" in caplog.text
    assert "taken as known; add viscous to `joint_terms`" in caplog.text
    found = prepared.solve("map_lmi")
    write_identification(found, prepared.parameters, tmp_path)
    robot = load_model(arm / "robot.urdf", "fixed")
    motion = read_true_motion([arm / "other"], robot)
    true = motion.samples.effort
    assert rms(torque_of_exported(robot, tmp_path, motion) - true) < most * rms(true)

    # Predictions and metrics agree with the written model.
    estimated = load_estimated_model(tmp_path, robot)
    assert estimated.estimate.known["joint2/coulomb"] == robot.joints[1].friction_loss
    force = predict(estimated.parameters, estimated.values, motion).gen_force
    slipping = np.abs(motion.samples.velocity).min(axis=1) > 0.02
    np.testing.assert_allclose(
        force[slipping], torque_of_exported(robot, tmp_path, motion)[slipping], atol=1e-6
    )
    parameters = estimated.parameters
    metrics = evaluate(parameters, {"it": estimated.values}, parameters.values, motion)["it"]
    obeys = is_slipping(motion.samples.velocity, robot.joints)
    counted = ((force - true) * obeys)[obeys.any(axis=1)]
    assert metrics.torque_rmse == pytest.approx(rms(counted))
    realistic = predict_realistic(
        parameters, estimated.values, RealisticMotion(motion.samples, motion)
    )
    np.testing.assert_allclose(realistic.torque, force, atol=1e-9)
    written = load_model(tmp_path / "model.urdf", "fixed")
    assert [(j.damping, j.friction_loss) for j in written.joints] == [
        (j.damping, j.friction_loss) for j in robot.joints
    ]


def test_an_estimate_without_friction_is_evaluated_without_it(arm, tmp_path):
    options = IdentifyOptions(joint_terms=("none",))
    prepared = BagRequest((arm / "log",), arm / "smooth.urdf", options, base="fixed").load()
    write_identification(prepared.solve("map_lmi"), prepared.parameters, tmp_path)
    robot = load_model(arm / "robot.urdf", "fixed")
    motion = read_true_motion([arm / "other"], robot)
    estimated = load_estimated_model(tmp_path, robot)
    metrics = evaluate(
        estimated.parameters, {"it": estimated.values}, estimated.parameters.values, motion
    )["it"]
    true = motion.samples.effort
    assert metrics.torque_rmse == pytest.approx(
        rms(torque_of_exported(robot, tmp_path, motion) - true), rel=1e-6
    )
    assert metrics.torque_rmse > 0.5 * rms(true)
