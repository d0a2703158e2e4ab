"""Rehearsals: a robot whose true parameters differ from its model file, for simulations."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.stance import Foot
from symbid_ros.errors import SimulationError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.joint_trajectory import read_trajectory
from symbid_ros.simulation.options import TruthOptions
from symbid_ros.simulation.standing_robot import StandingSimulator
from symbid_ros.simulation.tracking import static_torques, with_drive_terms, without_drive_terms
from symbid_ros.user_files import MEBI, read_regular

PLAN_FILE = "plan.json"
MAX_PLAN_BYTES = 16 * MEBI
LEAST_SIZE = 0.05  # of a drive, relative to the largest one; gravity may not load a joint


def draw_truth(
    robot: RobotModel,
    *,
    percent: float,
    seed: int,
    has_friction: bool,
    effort: FloatArray | None = None,
) -> RobotModel:
    """Return a robot whose links differ from the model, with or without friction and armature.

    Parameters
    ----------
    robot : RobotModel
        The model file's robot.
    percent : float
        Each moment of each link is uniform within ± this percentage; 0 for the model's links.
    seed : int
        Seed of links, friction and armature.
    has_friction : bool
        Whether all joints get friction and armature, in proportion to their efforts; otherwise
        those of the model file remain.
    effort : (J,) float64, optional
        Root mean square efforts, Nm or N; by default those that gravity causes in a robot that is
        held by its base.
    """
    truth = robot
    if percent > 0:
        links = ParameterSet(without_drive_terms(robot))
        drawn = draw_prior(links, "consistent", percent, seed).mean
        truth = robot.with_phi(links.apply(drawn).phi)
    if not has_friction:
        return truth
    torque = effort
    if torque is None:
        torque = np.sqrt(np.mean(static_torques(robot) ** 2, axis=0))
    size = np.maximum(torque, LEAST_SIZE * torque.max())
    return with_drive_terms(truth, size, np.random.default_rng([seed, 1]))


def standing_simulator(
    robot: RobotModel,
    path: Path,
    *,
    truth: TruthOptions,
    has_friction: bool,
    sensors: JointSensorOptions,
    base_sensors: BaseSensorOptions,
    seed: int | None,
) -> StandingSimulator:
    """Return a robot that stands as a plan says, and follows one of its trajectories.

    Parameters
    ----------
    robot : RobotModel
        The model file's robot.
    path : Path
        Folder of `symbid excite`, or a CSV file in it.
    truth : TruthOptions
        How the true robot differs from the model.
    has_friction : bool
        As in :func:`draw_truth`.
    sensors, base_sensors : JointSensorOptions, BaseSensorOptions
    seed : int or None
        Seed of the noise; None for sensors without noise.

    Raises
    ------
    SimulationError
        When the plan of the trajectory cannot be read or is not that of a standing robot.
    """
    folder = path.parent if path.suffix else path
    plan = _read_plan(folder, robot)
    trajectory = read_trajectory(path, robot.measured_joint_names)
    # The true robot must not depend on which trajectory of the plan it follows.
    planned = read_trajectory(folder, robot.measured_joint_names)
    effort = np.zeros(len(robot.joints))
    if planned.effort is not None:
        places = [robot.joint_names.index(name) for name in planned.names]
        effort[places] = np.sqrt(np.mean(planned.effort**2, axis=0))
    capacity = np.zeros(len(robot.joints))
    for name, limits in plan["joints"].items():
        largest = limits["noise_effort"]
        capacity[robot.joint_names.index(name)] = largest
    feet = [
        Foot(name, np.array(each["sole_m"]), each.get("radius_m", 0.0))
        for name, each in plan["feet"].items()
    ]
    return StandingSimulator(
        draw_truth(
            robot,
            percent=truth.truth_percent,
            seed=truth.truth_seed,
            has_friction=has_friction,
            effort=effort,
        ),
        trajectory,
        feet,
        sensors=sensors,
        base_sensors=base_sensors,
        capacity=capacity,
        unmeasured=[name for name, each in plan["feet"].items() if not each["has_sensor"]],
        seed=seed,
    )


def _read_plan(folder: Path, robot: RobotModel) -> dict[str, Any]:
    """Return the plan of a standing robot in a folder."""
    file = folder / PLAN_FILE
    try:
        plan: dict[str, Any] = json.loads(read_regular(file, MAX_PLAN_BYTES))
        if plan["feet"] and set(plan["joints"]) <= set(robot.joint_names):
            return plan
        why = "is the plan of another robot, or of one on a fixed base"
    except OSError as error:
        why = f"cannot be read ({error.strerror})"
    except (ValueError, KeyError, TypeError):
        why = "is not a plan of `symbid excite`"
    raise SimulationError(
        f"{file}: {why}; a robot with a floating base needs the folder of `symbid excite` with "
        "`feet`; give `base` fixed for a robot on a fixed base",
        "E925",
    )
