"""Noisy logs of arms whose drives have friction, armature, couplings or gains."""

from dataclasses import replace

import numpy as np
from analytic_log import waves
from random_robots import random_robot

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.parameters import ParameterSet

RATE, SECONDS = 200.0, 24.0
SLOWDOWN = 0.4
NOISE = 2e-3  # share of the joint's RMS effort


def arm(seed=3, links=4):
    return random_robot(seed, links=links, floating=False, wrench_frames=0)


def heavy_arm(seed=2, tilt=4e-9):
    """Return an arm of tonnes whose first axis is vertical up to rounding of a model's angles."""
    robot = arm(seed)
    first = robot.joints[0]
    axis = first.rotation @ first.axis
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    robot = robot.with_phi(1e3 * robot.phi)
    joints = tuple(replace(one, effort=np.inf) for one in robot.joints)
    return replace(robot, joints=joints, gravity=-9.81 * (axis + tilt * across))


def light_wrist(seed):
    """Return an arm whose last link is light, and a model of it with errors of 20 %."""
    robot = arm(seed=seed, links=6)
    robot = replace(robot, joints=tuple(replace(one, effort=np.inf) for one in robot.joints))
    links = ParameterSet(robot.with_phi(robot.phi * np.array([1.0] * 5 + [0.02])[:, None]))
    return links.model, links.apply(draw_prior(links, "consistent", 20.0, seed=3).mean)


def drives(robot, **terms):
    """Return the robot's parameters with the same values of some terms at every joint."""
    joints = tuple(
        replace(
            joint,
            damping=terms.get("viscous", 0.0),
            friction_loss=terms.get("coulomb", 0.0),
            armature=terms.get("armature", 0.0),
        )
        for joint in robot.joints
    )
    return ParameterSet(replace(robot, joints=joints))


def slow_waves(rng, time, joints, size, slowdown=SLOWDOWN):
    """Return sums of sines far below the cutoff of the filters, and their derivatives."""
    motion = waves(rng, slowdown * time, (joints,), size)
    return [slowdown**order * each for order, each in enumerate(motion)]


def samples_of(robot, time, position, velocity, acceleration):
    """Return a fixed robot's motion (N, J) at times (N,), s, without efforts."""
    rest = np.zeros((len(time), 3))
    return Samples(
        stamp=np.rint(1e9 * time).astype(np.int64),
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=np.zeros_like(position),
        base_angular_velocity=rest,
        base_angular_acceleration=rest,
        base_specific_force=rest - robot.gravity,
        wrenches=np.zeros((len(time), 0, 6)),
        wrench_frames=(),
    )


def log_of(
    robot,
    truth,
    seed=0,
    offset=0.0,
    moving=None,
    seconds=SECONDS,
    extra=None,
    load=0.0,
    gain=1.0,
    start=0.0,
    by_angle=None,
    slowdown=SLOWDOWN,
):
    """Return a noisy log of a robot whose drives are those of the parameters ``truth``.

    ``extra`` computes further torques from velocity and acceleration, ``by_angle`` from the
    position, ``load`` is Coulomb friction
    per torque of the links, and ``gain`` divides efforts.
    The log begins at ``start``.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1 / RATE)
    motion = slow_waves(rng, time, len(robot.joints), 1.2, slowdown)
    if moving is not None:
        motion = [each * moving for each in motion]
    samples = samples_of(robot, time, *motion)
    rows = equation_of_motion(truth, samples)
    effort = rows.K @ truth.values - rows.y + offset
    if extra is not None:
        effort += extra(*motion[1:])
    if by_angle is not None:
        effort += by_angle(motion[0])
    effort += load * np.abs(rows.K @ truth.values - rows.y) * np.sign(motion[1])
    effort /= gain
    effort += NOISE * effort.std(axis=0) * rng.normal(size=effort.shape)
    position = motion[0] + 1e-6 * rng.normal(size=effort.shape)
    return sy.Log.from_arrays(robot, time=start + time, position=position, effort=effort)


def stroke_and_rest(robot, joint, seed=0, seconds=8.0, *, lasts=0.6, stop=0.0):
    """Return time, positions and efforts of an arm of which one joint sticks after one stroke.

    The stroke of 0.3 rad ``lasts`` some seconds. A spring that the model lacks pushes the joint
    with ``stop``, Nm, where the stroke begins. Static friction takes any value while the joint
    sticks.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1 / RATE)
    position, velocity, acceleration = slow_waves(rng, time, len(robot.joints), 1.2, slowdown=1.0)
    x, speed = np.clip((time - 0.5) / lasts, 0.0, 1.0), 1 / lasts
    position[:, joint] = 0.3 * (10 * x**3 - 15 * x**4 + 6 * x**5)
    velocity[:, joint] = 0.3 * speed * (30 * x**2 - 60 * x**3 + 30 * x**4)
    acceleration[:, joint] = 0.3 * speed**2 * (60 * x - 180 * x**2 + 120 * x**3)
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    rows = equation_of_motion(truth, samples_of(robot, time, position, velocity, acceleration))
    effort = rows.K @ truth.values - rows.y
    effort[:, joint] -= stop * (1 - position[:, joint] / 0.3)
    static = np.tanh(np.cumsum(rng.normal(size=len(time))) / np.sqrt(RATE))
    effort[:, joint] += np.where(velocity[:, joint] == 0, 0.8 * static, 0.0)
    effort += NOISE * effort.std(axis=0) * rng.normal(size=effort.shape)
    return time, position, effort
