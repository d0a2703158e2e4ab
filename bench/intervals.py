"""Interval coverage on simulated arms whose joints have effects that the model lacks.

Usage: .venv/bin/python bench/intervals.py [--robots xarm7 ur10] [--effects none elasticity]
[--draws 3] [--seconds 60]

Prints a Markdown table. Each draw is a robot whose model file is wrong by up to 25 %, with viscous
and Coulomb friction that the file does not state, on its own motion with its own noise. It is
identified with default options. Robots are those of example-robot-data; a path to a URDF works too.

- links: determined parameters of links, their number in a draw
- covered: share of true values inside the 90 % interval
- square: mean square of the errors in standard deviations, 1 if these are right
- base: the same of determined combinations of links' parameters on which forces depend
"""

import argparse
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import files
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.intervals import HALF_WIDTH
from symbid_ros.model.parameters import ParameterSet

FloatArray = NDArray[np.float64]

ROBOTS = {
    "xarm7": "xarm7.urdf",
    "ur5": "ur5_robot.urdf",
    "ur10": "ur10_robot.urdf",
    "z1": "z1.urdf",
}
RATE = 250.0  # Hz
MODEL_ERROR = 25.0  # %
SINES = 6
FREQUENCIES = (0.03, 0.45)  # Hz
LARGEST_SPEED = 1.5  # rad/s
ENCODER, EFFORT = 2e-5, 3e-3  # noise: rad, and share of a joint's RMS effort
# Friction, as shares of a joint's RMS effort: Coulomb, and viscous at 1 rad/s.
COULOMB, VISCOUS = 0.10, 0.08


@dataclass(frozen=True)
class Motion:
    """Joint motion (N, J) at times (N,)."""

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


# Additional torque (N, J) of an effect, from the motion, the load and its RMS (J,), Nm.
Effect = Callable[[Motion, FloatArray, FloatArray], FloatArray]


def stribeck(motion: Motion, _: FloatArray, size: FloatArray) -> FloatArray:
    """Friction that rises towards zero speed, faster and in another shape than the model's."""
    speed = motion.velocity
    return 0.06 * size * np.sign(speed) * np.exp(-((speed / 0.08) ** 2))


def load_friction(motion: Motion, load: FloatArray, _: FloatArray) -> FloatArray:
    """Coulomb friction in proportion to the load of the gear."""
    return 0.06 * np.abs(load) * np.sign(motion.velocity)


def cogging(motion: Motion, _: FloatArray, size: FloatArray) -> FloatArray:
    """Torque ripple of a drive with 21 periods a turn."""
    return 0.02 * size * np.sin(21 * motion.position + 0.3)


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "none": (),
    "stribeck": (stribeck,),
    "load_friction": (load_friction,),
    "cogging": (cogging,),
    "elasticity": (),
    "all": (stribeck, load_friction, cogging),
}
# Compliance of elastic joints, as a share of that of the softest joint: one that deflects by
# DEFLECTION under its RMS effort or, with a locked drive, swings its links at RESONANCE.
COMPLIANCE = {"elasticity": 1.0, "all": 0.5}
DEFLECTION = 2e-3  # rad
RESONANCE = 8.0  # Hz


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--robots", nargs="+", default=list(ROBOTS))
    options.add_argument("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS))
    options.add_argument("--draws", type=int, default=3)
    options.add_argument("--seed", type=int, default=100)
    options.add_argument("--seconds", type=float, default=60.0)
    given = options.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    logging.disable(logging.WARNING)
    print("| robot | effect | links | covered | square | base | covered | square | alarms |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    with threadpool_limits(1):
        for name in given.robots:
            robot = load_arm(name)
            for effect in given.effects:
                scores = list(draws(robot, effect, given.draws, given.seed, given.seconds))
                print(table_row(name, effect, scores), flush=True)


def load_arm(name: str) -> sy.RobotModel:
    """Load a robot of example-robot-data by its short name, or any URDF by its path."""
    if name not in ROBOTS:
        return sy.load_model(Path(name), base="fixed")
    for each in files("example-robot-data") or ():
        if each.name == ROBOTS[name]:
            return sy.load_model(Path(str(each.locate())), base="fixed")
    raise SystemExit(f"example-robot-data has no {ROBOTS[name]}; give the path of a URDF")


@dataclass(frozen=True)
class Draw:
    """One simulated log and its identification.

    Attributes
    ----------
    links, base : (d,) float64
        Errors of determined parameters, in standard deviations.
    alarms : int
    """

    links: FloatArray
    base: FloatArray
    alarms: int


def draws(
    robot: sy.RobotModel, effect: str, count: int, seed: int, seconds: float
) -> Iterator[Draw]:
    """Simulate and identify several logs."""
    for number in range(seed, seed + count):
        truth, log = simulate(robot, effect, number, seconds)
        model = inaccurate(robot, number)
        found = sy.identify(model, log, no_holdout=True, unchecked=True)
        yield judge(found, truth)


def inaccurate(robot: sy.RobotModel, seed: int) -> sy.RobotModel:
    """Return a robot whose links are wrong by up to 25 %, and physically possible."""
    parameters = ParameterSet(robot)
    return parameters.apply(draw_prior(parameters, "consistent", MODEL_ERROR, seed).mean)


def simulate(
    robot: sy.RobotModel, effect: str, seed: int, seconds: float
) -> tuple[dict[str, float], sy.Log]:
    """Return the true parameters by name, and a log of a robot with an effect.

    The encoders are on the motors' side: an elastic joint reads its deflection too.
    """
    rng = np.random.default_rng(seed)
    motion = excite(robot, rng, seconds)
    parameters = ParameterSet(robot)
    load = torque(robot, motion) @ parameters.values
    size = np.sqrt(np.mean(load**2, axis=0))
    size = np.maximum(size, 0.02 * size.max())
    friction = COULOMB * size * rng.uniform(0.5, 1.5, len(size))
    damping = VISCOUS * size * rng.uniform(0.5, 1.5, len(size))
    effort = load + friction * np.sign(motion.velocity) + damping * motion.velocity
    for each in EFFECTS[effect]:
        effort = effort + each(motion, load, size)
    compliance = np.minimum(
        DEFLECTION / size, 1 / (inertia(robot, motion) * (2 * np.pi * RESONANCE) ** 2)
    )
    position = motion.position + COMPLIANCE.get(effect, 0.0) * compliance * effort
    log = sy.Log.from_arrays(
        robot,
        time=motion.time,
        position=position + ENCODER * rng.normal(size=position.shape),
        effort=effort + EFFORT * size * rng.normal(size=effort.shape),
        name=f"{effect}, seed {seed}",
    )
    truth = dict(zip(parameters.names, parameters.values.tolist(), strict=True))
    for joint, one, other in zip(robot.joint_names, damping, friction, strict=True):
        truth |= {f"{joint}/viscous": float(one), f"{joint}/coulomb": float(other)}
    return truth, log


def excite(robot: sy.RobotModel, rng: np.random.Generator, seconds: float) -> Motion:
    """Return a random sum of sines for each joint, within a speed limit."""
    joints = len(robot.joints)
    time = np.arange(0.0, seconds, 1 / RATE)
    omega = 2 * np.pi * rng.uniform(*FREQUENCIES, (SINES, joints))
    phase = rng.uniform(0, 2 * np.pi, (SINES, joints))
    amplitude = rng.uniform(0.3, 1.0, (SINES, joints)) / omega
    angle = time[:, None, None] * omega + phase
    velocity = np.sum(amplitude * omega * np.cos(angle), axis=1)
    scale = LARGEST_SPEED / np.abs(velocity).max(axis=0)
    return Motion(
        time,
        scale * np.sum(amplitude * np.sin(angle), axis=1),
        scale * velocity,
        -scale * np.sum(amplitude * omega**2 * np.sin(angle), axis=1),
    )


def torque(robot: sy.RobotModel, motion: Motion) -> FloatArray:
    """Return the regressor (N, J, p) of the links, whose joints have no friction."""
    joints = tuple(
        replace(joint, damping=0.0, friction_loss=0.0, armature=0.0) for joint in robot.joints
    )
    count = len(motion.time)
    rest = np.zeros((count, 3))
    samples = Samples(
        stamp=np.arange(count),
        position=motion.position,
        velocity=motion.velocity,
        acceleration=motion.acceleration,
        effort=np.zeros_like(motion.position),
        base_angular_velocity=rest,
        base_angular_acceleration=rest,
        base_specific_force=rest - robot.gravity,
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )
    return equation_of_motion(ParameterSet(replace(robot, joints=joints)), samples).K


def inertia(robot: sy.RobotModel, motion: Motion) -> FloatArray:
    """Return the mean inertia (J,) that each joint moves when the others rest."""
    some = slice(None, None, max(1, len(motion.time) // 50))
    rest = np.zeros_like(motion.position[some])
    still = Motion(motion.time[some], motion.position[some], rest, rest)
    values = ParameterSet(robot).values
    held = torque(robot, still) @ values
    moved = [
        (torque(robot, replace(still, acceleration=rest + unit)) @ values - held)[:, joint]
        for joint, unit in enumerate(np.eye(rest.shape[1]))
    ]
    return np.array([each.mean() for each in moved])


def judge(found: sy.Result, truth: dict[str, float]) -> Draw:
    """Compare the determined parameters with the truth."""
    estimate, count = found.estimate, 10 * len(found.links)
    true = np.array([truth.get(name, 0.0) for name in estimate.names])
    some = np.flatnonzero(estimate.determined[:count])
    grouping = base_parameters(found._parameters)
    base = [
        (row @ true - one.value) / one.std
        for row, one in zip(grouping.matrix, estimate.verdict.base, strict=True)
        if one.determined and not row[count:].any()
    ]
    errors = (true - estimate.value)[some] / estimate.std[some]
    return Draw(errors, np.array(base), len(found.alarms))


def table_row(robot: str, effect: str, scores: list[Draw]) -> str:
    """Return the means over the draws."""
    cells = []
    for name in ("links", "base"):
        errors = np.concatenate([getattr(each, name) for each in scores])
        covered, square = np.mean(np.abs(errors) < HALF_WIDTH), np.mean(errors**2)
        cells.append(f"{len(errors) / len(scores):.0f} | {covered:.2f} | {square:.2f}")
    alarmed = sum(each.alarms > 0 for each in scores)
    return f"| {robot} | {effect} | {' | '.join(cells)} | {alarmed} of {len(scores)} |"


if __name__ == "__main__":
    main()
