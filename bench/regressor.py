"""Time of the regressor per sample, compared with Pinocchio's in a Python loop, on one core.

"Dense" fills an array (N, n, p), as Pinocchio's loop does. "Packed" are the structural non-zeros
alone. Calls alternate, and medians of processor time are compared. The second table is of chains
of revolute joints, whose rows have the most non-zeros. "Averaged" are the means over a window that
identification uses, which need no rows of single samples.

Usage: .venv/bin/python bench/regressor.py [--samples 256] [--repeats 25] [--plot FILE.svg]
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from scipy.sparse import csr_array
from tables import markdown, save_plot
from threadpoolctl import threadpool_limits

from symbid_ros.dynamics.inertial_rows import averaged_rows, dense_rows, packed_rows
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import STANDARD_GRAVITY, Joint, Link, RobotModel
from symbid_ros.package_paths import config_file

require_packages("pin", EXAMPLE_ROBOTS)
import pinocchio  # noqa: E402

ROBOT_DATA = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"
ROBOTS = {
    "Symbitron": config_file("symbitron.urdf"),
    "Solo12": ROBOT_DATA / "solo_description/robots/solo12.urdf",
    "ANYmal C": ROBOT_DATA / "anymal_c_simple_description/urdf/anymal.urdf",
    "G1": ROBOT_DATA / "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "Talos": ROBOT_DATA / "talos_data/robots/talos_full_v2.urdf",
}
JOINTS = 6, 12, 20, 30, 40, 60


def main() -> None:
    """Time legged robots and chains of joints."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--samples", type=int, default=256, help="samples in a block")
    options.add_argument("--repeats", type=int, default=25, help="repetitions of each call")
    options.add_argument("--plot", type=Path, help="SVG of the growth with the number of joints")
    given = options.parse_args()
    with threadpool_limits(1):
        print(comparison(given.samples, given.repeats))
        print()
        growth = {count: of_chain(count, given.samples) for count in JOINTS}
    times = {
        count: microseconds(calls, given.samples, given.repeats) for count, calls in growth.items()
    }
    kinds = "averaged", "packed", "dense"
    rows = [(count, *each) for count, each in times.items()]
    print(markdown(("joints of a chain", *(f"{kind} (µs)" for kind in kinds)), rows, 3))
    if given.plot:
        columns = zip(*times.values(), strict=True)
        lines = {f"{kind}, µs per sample": one for kind, one in zip(kinds, columns, strict=True)}
        save_plot(given.plot, "joints", JOINTS, lines)


def comparison(count: int, repeats: int) -> str:
    """Return the table of all robots."""
    rows = []
    for name, path in ROBOTS.items():
        model = load_model(path, "floating")
        calls = (*own(model, count), loop(path, count))
        packed, dense, peer = microseconds(calls, count, repeats)
        sizes = model.dof, len(ParameterSet(model))
        rows.append((name, *sizes, packed, dense, peer, packed / peer, dense / peer))
    head = (
        "robot | coordinates | parameters | packed (µs) | dense (µs) | Pinocchio (µs) "
        "| packed / Pinocchio | dense / Pinocchio"
    )
    return markdown(head.split(" | "), rows, 3)


def microseconds(calls: tuple[Callable[[], None], ...], count: int, repeats: int) -> list[float]:
    """Return the median processor time of each call per sample, µs; the calls alternate."""
    inner = max(1, 1024 // count)
    times = np.empty((repeats + 1, len(calls)))
    for row in times:
        for index, call in enumerate(calls):
            start = time.process_time()
            for _ in range(inner):
                call()
            row[index] = time.process_time() - start
    median: list[float] = (1e6 * np.median(times[1:], axis=0) / (inner * count)).tolist()
    return median


def own(model: RobotModel, count: int) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return calls that compute packed and dense rows of random samples."""
    parameters, samples = ParameterSet(model), random_samples(model, count)

    def packed() -> None:
        packed_rows(parameters, samples)

    def dense() -> None:
        dense_rows(parameters, samples)

    return packed, dense


def of_chain(joints: int, count: int) -> tuple[Callable[[], None], ...]:
    """Return calls that compute averaged, packed and dense rows of a chain's random samples."""
    model = chain(joints)
    parameters, samples = ParameterSet(model), random_samples(model, count)
    weights = csr_array(np.full((1, count), 1 / count))
    nothing = np.zeros((0, parameters.inertial))

    def averaged() -> None:
        averaged_rows(parameters, samples, weights, nothing)

    return averaged, *own(model, count)


def chain(count: int) -> RobotModel:
    """Return a floating chain of revolute joints with random axes."""
    rng = np.random.default_rng(count)
    axes = rng.normal(size=(count, 3))
    joints = tuple(
        Joint(f"joint_{k}", "revolute", k, np.eye(3), np.array([0.1, 0.0, 0.0]), axis)
        for k, axis in enumerate(axes / np.linalg.norm(axes, axis=1, keepdims=True))
    )
    links = tuple(Link(f"link_{k}", np.zeros(10)) for k in range(count + 1))
    return RobotModel(f"chain_{count}", links, joints, (), True, STANDARD_GRAVITY, "chain")


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
