"""Directions of gravity that are found on fixed arms of example-robot-data.

Usage: .venv/bin/python bench/base_gravity.py [--robots ur5 panda] [--draws 3] [--seed 0]

Prints a Markdown table. Each arm is simulated for 30 s with Coulomb friction of some share of its
effort limits. The model file is wrong by up to 25 % in every link, and lets gravity point down,
while the arm is tilted, hangs under the ceiling or is mounted at random. Cells state the largest
error of the direction in degrees, and how many of the draws were found. In the last two columns no
direction should be found: the arm is mounted as in its file, with right efforts or with efforts of
the wrong sign.
"""

import argparse
import logging
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from numpy.typing import NDArray
from package_robots import load_robot
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.conventions.base_gravity import find_gravity
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))
from arm_log import arm_streams

FloatArray = NDArray[np.float64]

ARMS = "ur5", "ur10", "panda", "xarm7", "z1", "kinova", "talos_left_arm"
FRICTION = 0.0, 0.05, 0.15
TILTS = 5.0, 20.0  # degrees
OTHER = "ceiling", "random"
RIGHT, WRONG_SIGN = "as in the file", "wrong sign"
COLUMNS = (*(f"tilted {tilt:g}°" for tilt in TILTS), *OTHER, RIGHT, WRONG_SIGN)
SECONDS = 30.0
MODEL_ERROR = 25.0  # %


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--robots", nargs="+", default=ARMS)
    options.add_argument("--draws", type=int, default=3)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    logging.disable(logging.WARNING)
    threadpool_limits(1)
    print(f"| robot | friction | {' | '.join(COLUMNS)} |")
    print("|---" * (2 + len(COLUMNS)) + "|")
    for name in given.robots:
        robot, _ = load_robot(name, "fixed")
        for friction in FRICTION:
            cells = [
                cell(
                    [
                        error(robot, friction, column, given.seed + draw)
                        for draw in range(given.draws)
                    ]
                )
                for column in COLUMNS
            ]
            print(f"| {name} | {100 * friction:g} % | {' | '.join(cells)} |", flush=True)


def cell(errors: list[float]) -> str:
    """Return the largest of the errors that are known, and how many these are."""
    found = [one for one in errors if np.isfinite(one)]
    return f"{max(found):.2f} ({len(found)}/{len(errors)})" if found else "none"


def error(robot: sy.RobotModel, friction: float, mounting: str, seed: int) -> float:
    """Return the error of the direction that is found, degrees; NaN if none is found."""
    rng = np.random.default_rng(seed)
    gravity = mounted(robot.gravity, mounting, rng)
    read = arm_streams(replace(robot, gravity=gravity), SECONDS, seed, friction=friction)
    if mounting == WRONG_SIGN:
        read = replace(read, joints=replace(read.joints, effort=-read.joints.effort))
    parameters = ParameterSet(robot)
    drawn = draw_prior(parameters, "consistent", MODEL_ERROR, seed).mean
    wrong = robot.with_phi(parameters.link_phi(drawn))
    found = find_gravity(AlignedLog(Log.from_streams(read), wrong), wrong)
    if found is None:
        return np.nan
    cosine = np.dot(found.direction, gravity) / np.linalg.norm(gravity)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def mounted(gravity: FloatArray, mounting: str, rng: np.random.Generator) -> FloatArray:
    """Return gravity in the axes of a base that is mounted in some way."""
    if mounting == "ceiling":
        return -gravity
    if mounting == "random":
        return Rotation.random(random_state=rng).apply(gravity)
    if mounting in (RIGHT, WRONG_SIGN):
        return gravity
    axis = np.append(rng.standard_normal(2), 0.0)
    tilt = np.radians(TILTS[COLUMNS.index(mounting)])
    return Rotation.from_rotvec(tilt * axis / np.linalg.norm(axis)).apply(gravity)


if __name__ == "__main__":
    main()
