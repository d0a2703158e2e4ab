"""Time of the regressor per sample, compared with Pinocchio's in a Python loop.

Both fill an array with one matrix per sample, on one core. Prints a Markdown table.

Usage: .venv/bin/python bench/regressor.py [--samples 512] [--repeats 20]
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio
from threadpoolctl import threadpool_limits

from symbid_ros.dynamics.regressor import Samples, equation_of_motion
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.package_paths import config_file

ROBOT_DATA = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"


def main() -> None:
    """Time both on a biped, a quadruped and a humanoid."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--samples", type=int, default=512, help="samples in a block")
    options.add_argument("--repeats", type=int, default=20, help="repetitions; the fastest counts")
    given = options.parse_args()
    robots = {
        "Symbitron": config_file("symbitron.urdf"),
        "ANYmal C": ROBOT_DATA / "anymal_c_simple_description/urdf/anymal.urdf",
        "G1": ROBOT_DATA / "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    }
    print("| robot | coordinates | parameters | here (µs) | Pinocchio (µs) | ratio |")
    print("|---|---|---|---|---|---|")
    for name, path in robots.items():
        model = load_model(path, "floating")
        parameters = ParameterSet(model)
        with threadpool_limits(1):
            here, peer = fastest(
                (block(parameters, given.samples), loop(path, given.samples)), given.repeats
            )
        here, peer = 1e6 * here / given.samples, 1e6 * peer / given.samples
        sizes = f"{model.dof} | {len(parameters)}"
        print(f"| {name} | {sizes} | {here:.1f} | {peer:.1f} | {peer / here:.2f} |")


def fastest(calls: tuple[Callable[[], None], ...], repeats: int) -> list[float]:
    """Return the smallest processor time of each call, s; the calls alternate."""
    times = np.empty((repeats, len(calls)))
    for row in times:
        for index, call in enumerate(calls):
            start = time.process_time()
            call()
            row[index] = time.process_time() - start
    return times.min(axis=0).tolist()


def block(parameters: ParameterSet, count: int) -> Callable[[], None]:
    """Return a call that computes the equation of motion of random samples."""
    samples = random_samples(parameters.model, count)
    return lambda: equation_of_motion(parameters, samples)


def random_samples(model: RobotModel, count: int) -> Samples:
    rng = np.random.default_rng(0)
    joints, base = (count, len(model.joints)), (count, 3)
    return Samples(
        stamp=np.arange(count),
        position=rng.uniform(-1, 1, joints),
        velocity=rng.normal(size=joints),
        acceleration=rng.normal(size=joints),
        effort=rng.normal(size=joints),
        base_angular_velocity=rng.normal(size=base),
        base_angular_acceleration=rng.normal(size=base),
        base_specific_force=rng.normal(size=base),
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )


def loop(path: Path, count: int) -> Callable[[], None]:
    """Return a call that computes and stores Pinocchio's regressors one by one."""
    model = pinocchio.buildModelFromUrdf(str(path), pinocchio.JointModelFreeFlyer())
    data = model.createData()
    rng = np.random.default_rng(0)
    joints = rng.uniform(-1, 1, (count, model.nq))
    configurations = [pinocchio.normalize(model, q) for q in joints]
    velocities, accelerations = rng.normal(size=(2, count, model.nv))

    def regressors() -> None:
        kept = np.empty((count, model.nv, 10 * (model.njoints - 1)))
        for K, q, v, a in zip(kept, configurations, velocities, accelerations, strict=True):
            K[:] = pinocchio.computeJointTorqueRegressor(model, data, q, v, a)

    return regressors


if __name__ == "__main__":
    main()
