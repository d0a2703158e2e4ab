"""A gripper whose second finger mimics the first is identified from the first finger's data."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from drive_logs import samples_of
from tree_simulation import TreeSimulation

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.frames import Frame
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Mimic
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.simulation.recording import record

PANDA = (
    Path(pinocchio.__file__).parents[4]
    / "share/example-robot-data/robots/panda_description/urdf/panda.urdf"
)
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


class Followed(TreeSimulation):
    """The joints follow sines exactly; their efforts are MuJoCo's inverse dynamics.

    Only the first finger is published, with the force that moves both.
    """

    def __init__(self, model, seconds, seed):
        super().__init__(model, seconds, seed)
        self.m.opt.timestep = 1e-3
        self.all_names, self.ticks = model.joint_names, 0
        self.kept = [k for k, name in enumerate(self.all_names) if name != FINGERS[1]]
        self.joint_names = tuple(self.all_names[k] for k in self.kept)
        first, second = (self.all_names.index(name) for name in FINGERS)
        for table in (self.frequency, self.phase):
            table[:, second] = table[:, first]

    def step(self):
        d, rate = self.d, 2 * np.pi * self.frequency
        angle = rate * self.ticks * 1e-3 + self.phase
        d.time = self.ticks * 1e-3
        d.qpos[:] = np.sin(angle).mean(axis=0)
        d.qvel[:] = (rate * np.cos(angle)).mean(axis=0)
        d.qacc[:] = (-(rate**2) * np.sin(angle)).mean(axis=0)
        mujoco.mj_inverse(self.m, d)
        effort = d.qfrc_inverse.copy()
        first, second = (self.all_names.index(name) for name in FINGERS)
        effort[first] += effort[second]
        self.ticks += 1
        names, self.joint_names = self.joint_names, self.all_names
        instant = self._instant(effort, np.zeros((0, 6)))
        self.joint_names = names
        columns = (
            *("joint_position", "joint_velocity", "joint_effort", "true_position"),
            *("true_velocity", "true_acceleration", "true_effort"),
        )
        return replace(instant, **{name: getattr(instant, name)[self.kept] for name in columns})


@pytest.fixture(scope="module")
def gripper(tmp_path_factory):
    folder = tmp_path_factory.mktemp("panda")
    robot = load_model(PANDA, "fixed")
    assert [robot.joints[k].name for k in robot.followers] == [FINGERS[1]]
    smooth = [replace(joint, damping=0.0, friction_loss=0.0) for joint in robot.joints]
    frame = Frame("imu_link", 0, np.eye(3), np.zeros(3))
    robot = replace(robot, joints=tuple(smooth), frames=(frame,))
    (folder / "robot.urdf").write_text(urdf_text(robot))
    record(Followed(robot, 2.6, 1), folder / "log")
    record(Followed(robot, 0.8, 2), folder / "other")
    return folder, robot


@pytest.mark.parametrize("method", ["map_lmi", "wls_rc"])
def test_a_mimic_joint_needs_no_data(gripper, method):
    folder, robot = gripper
    cutoff = None if method == "map_lmi" else 0.0
    options = IdentifyOptions(
        prior_percent=25.0, method=method, cutoff=cutoff, joint_terms=("none",)
    )
    request = BagRequest((folder / "log",), folder / "robot.urdf", options, base="fixed")
    prepared = request.load()
    wrong = robot.with_phi(1.2 * robot.phi)
    parameters = prepared.parameters
    prior_mean = replace(prepared.prior, mean=parameters.values * 1.2)
    found = prepared.with_prior(prior_mean).solve(method)
    motion = read_true_motion([folder / "other"], robot)
    candidates = {"it": found.estimate.value, "prior": wrong.phi[parameters.links].ravel()}
    metrics = evaluate(parameters, candidates, parameters.values, motion)
    assert metrics["it"].torque_rmse < 0.03 * metrics["prior"].torque_rmse
    # Their sum is determined, because the force on the first finger moves both.
    mass = [found.estimate.names.index(f"panda_{side}finger/m") for side in ("left", "right")]
    true = parameters.values[mass].sum()
    assert found.estimate.value[mass].sum() == pytest.approx(true, rel=0.05)


def test_the_data_choose_the_terms_of_measured_joints_alone(gripper):
    folder, _ = gripper
    request = BagRequest((folder / "log",), folder / "robot.urdf", base="fixed")
    estimate = request.load().solve().estimate
    assert estimate.joint_terms is not None
    assert not estimate.joint_terms[FINGERS[1]]
    fixed = {name for name in estimate.names if name.startswith(FINGERS[1])}
    assert fixed <= estimate.fixed


def test_a_validation_does_not_miss_a_mimic_joint(gripper, tmp_path):
    """Its load is judged at its leader."""
    folder, _ = gripper
    robot = load_model(folder / "robot.urdf", "fixed")
    found = sy.identify(robot, sy.load_bag(folder / "log", robot), joint_terms=("none",))
    found.save(tmp_path / "result")
    judged = sy.validate(tmp_path / "result", sy.load_bag(folder / "other"))
    assert FINGERS[1] not in judged.not_judged
    assert any(FINGERS[0] in one.name for one in judged.coordinates)


def test_friction_that_the_file_states_of_followers_is_that_of_their_leader():
    """Otherwise a gripper without friction needs a leader that drives itself."""
    robot = load_model(PANDA, "fixed")
    rng = np.random.default_rng(3)
    joints = [
        replace(joint, damping=a, friction_loss=b, armature=c)
        for joint, (a, b, c) in zip(robot.joints, rng.uniform(0.1, 2.0, (9, 3)), strict=True)
    ]
    first, second = (robot.joint_names.index(name) for name in FINGERS)
    joints[second] = replace(joints[second], mimic=Mimic(first, -1.7, 0.01))
    robot = replace(robot, joints=tuple(joints))
    free = ParameterSet(robot, ("viscous", "coulomb", "armature"))
    assert not any(free.values[columns][second] for columns in free.term_columns.values())
    motion = rng.standard_normal((3, 50, 9))
    motion = [robot.apply_mimics(each, rates=order > 0) for order, each in enumerate(motion)]
    samples = samples_of(robot, np.arange(50.0), *motion)
    known, fitted = (equation_of_motion(one, samples) for one in (ParameterSet(robot), free))
    np.testing.assert_allclose(
        fitted.K @ free.values - fitted.y,
        known.K @ ParameterSet(robot).values - known.y,
        atol=1e-9,
    )
    again = ParameterSet(free.apply(free.values), free.terms)
    np.testing.assert_allclose(again.values, free.values)
