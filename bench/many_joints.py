"""Time and memory of `identify` with default options on robots with many joints.

Usage: .venv/bin/python bench/many_joints.py [--joints 10 20 40 60] [--seconds 60] [--rate 250]

The robots are chains of revolute joints on a fixed base, with viscous and Coulomb friction and
armature, whose flat rows are the widest that a number of joints can have. Each moves at random, and
its model file is wrong by up to 25 %. Every log is identified in a process of its own, with one
thread. The peak is that of the whole process.
"""

import argparse
import multiprocessing
import time

import numpy as np
from foreign_robots import (
    EFFORT,
    ENCODER,
    LARGEST,
    FloatArray,
    inaccurate,
    move,
    plain,
    torque,
    with_friction,
)
from process_usage import peak_memory
from tables import markdown
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.tree import STANDARD_GRAVITY, Joint, Link, RobotModel

SPACING = 0.1  # m; between joints
SAMPLES_AT_ONCE = 500


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--joints", type=int, nargs="+", default=[10, 20, 40, 60])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=250.0, help="Hz")
    given = parser.parse_args()
    rows = []
    for count in given.joints:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append((count, *pool.apply(usage, (count, given.seconds, given.rate))))
    print(markdown(("joints", "parameters", "s", "processor s", "peak MB"), rows, 3))


def usage(count: int, seconds: float, rate: float) -> tuple[int, float, float, float]:
    """Return the parameters found, seconds, processor seconds, and the peak memory, MB."""
    with threadpool_limits(1):
        model, log = recorded(count, seconds, rate)
        clock, processor = time.perf_counter(), time.process_time()
        found = sy.identify(model, log, jobs=1)
        taken = time.perf_counter() - clock, time.process_time() - processor
    return len(found.estimate.names), *taken, peak_memory()


def recorded(count: int, seconds: float, rate: float) -> tuple[RobotModel, sy.Log]:
    """Return the model file's robot, and a noisy log of the true one."""
    rng = np.random.default_rng(count)
    robot = chain(count, rng)
    motion = move(robot, (), rng, seconds, rate)
    size = np.sqrt(np.mean(efforts(plain(robot), motion) ** 2, axis=0))
    truth = with_friction(robot, True, size, rng)
    position = motion.position + ENCODER * rng.normal(size=motion.position.shape)
    noise = EFFORT * LARGEST * size * rng.normal(size=position.shape)
    effort = efforts(truth, motion) + noise
    log = sy.Log.from_arrays(truth, time=motion.stamp, position=position, effort=effort)
    return inaccurate(truth, False, size, count, rng), log


def chain(count: int, rng: np.random.Generator) -> RobotModel:
    """Return a chain of revolute joints with random axes on a fixed base."""
    axes = rng.normal(size=(count, 3))
    joints = tuple(
        Joint(f"joint_{k}", "revolute", k, np.eye(3), np.array([SPACING, 0.0, 0.0]), axis)
        for k, axis in enumerate(axes / np.linalg.norm(axes, axis=1, keepdims=True))
    )
    links = tuple(Link(f"link_{k}", rod(rng)) for k in range(count + 1))
    return RobotModel(f"chain_{count}", links, joints, (), False, STANDARD_GRAVITY, "chain")


def rod(rng: np.random.Generator) -> FloatArray:
    """Return φ (10,) of a rod between two joints, with its mass a little beside the middle."""
    mass = rng.uniform(0.3, 1.0)
    com = np.array([SPACING / 2, 0.0, 0.0]) + SPACING * rng.uniform(-0.1, 0.1, 3)
    square = mass * SPACING**2 * rng.uniform(0.8, 1.2, 3)
    return phi_from_com(mass, com, np.diag(square * [0.06, 0.12, 0.12]))


def efforts(robot: RobotModel, motion: Samples) -> FloatArray:
    """Return the torques (N, J), Nm, from the rows of a few samples at a time."""
    starts = range(0, len(motion), SAMPLES_AT_ONCE)
    return np.concatenate(
        [torque(robot, motion[start : start + SAMPLES_AT_ONCE]) for start in starts]
    )


if __name__ == "__main__":
    main()
