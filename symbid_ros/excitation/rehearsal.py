"""Rehearsals: a robot whose true parameters differ from its model file, for simulations."""

import numpy as np

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.tracking import static_torques, with_drive_terms, without_drive_terms

LEAST_SIZE = 0.05  # of a drive, relative to the largest one; gravity may not load a joint


def draw_truth(robot: RobotModel, *, percent: float, seed: int, has_friction: bool) -> RobotModel:
    """Return a robot whose links differ from the model, with or without friction and armature.

    Parameters
    ----------
    robot : RobotModel
        The model file's robot, with a fixed base.
    percent : float
        Each moment of each link is uniform within ± this percentage; 0 for the model's links.
    seed : int
        Seed of links, friction and armature.
    has_friction : bool
        Whether all joints get friction and armature, in proportion to the torques that gravity
        causes in the model; otherwise those of the model file remain.
    """
    truth = robot
    if percent > 0:
        links = ParameterSet(without_drive_terms(robot))
        drawn = draw_prior(links, "consistent", percent, seed).mean
        truth = robot.with_phi(links.apply(drawn).phi)
    if not has_friction:
        return truth
    torque = np.sqrt(np.mean(static_torques(robot) ** 2, axis=0))
    size = np.maximum(torque, LEAST_SIZE * torque.max())
    return with_drive_terms(truth, size, np.random.default_rng([seed, 1]))
