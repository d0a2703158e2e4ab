"""Rehearsals: a robot whose true parameters differ from its model file, for simulations."""

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.excitation.fourier import DrivenJoints
from symbid_ros.excitation.objective import ExpectedInformation
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_trajectory import JointTrajectory
from symbid_ros.simulation.tracking import with_drive_terms, without_drive_terms

SAMPLES = 400  # instants at which the efforts of a trajectory are computed


def draw_truth(
    robot: RobotModel,
    trajectory: JointTrajectory,
    *,
    percent: float,
    seed: int,
    has_friction: bool,
) -> RobotModel:
    """Return a robot whose links differ from the model, with or without friction and armature.

    Parameters
    ----------
    robot : RobotModel
        The model file's robot, with a fixed base.
    trajectory : JointTrajectory
        Friction is in proportion to the efforts that it needs.
    percent : float
        Each moment of each link is uniform within ± this percentage; 0 for the model's links.
    seed : int
        Seed of links, friction and armature.
    has_friction : bool
        Whether all joints get friction and armature; otherwise those of the model file remain.
    """
    truth = robot
    if percent > 0:
        links = ParameterSet(without_drive_terms(robot))
        drawn = draw_prior(links, "consistent", percent, seed).mean
        truth = robot.with_phi(links.apply(drawn).phi)
    if not has_friction:
        return truth
    effort = np.sqrt(np.mean(trajectory_efforts(robot, trajectory) ** 2, axis=0))
    size = np.maximum(effort, 0.05 * effort.max())
    return with_drive_terms(truth, size, np.random.default_rng([seed, 1]))


def trajectory_efforts(robot: RobotModel, trajectory: JointTrajectory) -> FloatArray:
    """Return the efforts (N, J) of a robot without friction along a trajectory, Nm or N."""
    plain = ParameterSet(without_drive_terms(robot))
    places = tuple(robot.joint_names.index(name) for name in trajectory.names)
    joints = DrivenJoints(plain.model, places, np.zeros(len(robot.joints)))
    expected = ExpectedInformation(
        plain, plain.values, np.zeros((len(plain), 0)), np.ones(robot.dof), joints
    )
    motion = trajectory.at(np.linspace(0.0, trajectory.duration, SAMPLES))
    return np.asarray(expected.rows(motion) @ plain.values)


def effort_capacity(robot: RobotModel, trajectory: JointTrajectory) -> FloatArray:
    """Return the largest effort (J,) of joints: the limit, or twice what the trajectory needs."""
    limits = np.array([joint.effort for joint in robot.joints])
    needed = np.abs(trajectory_efforts(robot, trajectory)).max(axis=0)
    guess = np.maximum(2 * needed, 0.1 * needed.max())
    return np.where(np.isfinite(limits) & (limits > 0), limits, guess)
