"""Default options on robots of example-robot-data, judged against the noise-free truth.

Usage: .venv/bin/python bench/foreign_robots.py [--robots ur5 anymal] [--draws 1] [--seconds 60]
[--rate 250] [--effort-noise 0.1] [--warm-up 0] [--model-errors consistent]

Prints a Markdown table. The model file of each draw is wrong by up to 25 % in every link, and the
robot moves at random: an arm on a fixed base, a legged robot with all feet on the ground. Encoders,
efforts, IMU and foot sensors are noisy; efforts by 0.1 % of a joint's largest effort. Any robot of
the package can be named by its file, or by folder/file.

- friction: `absent` or `present` (viscous, Coulomb and armature); `stated`: the file states values,
  wrong by up to 50 %, or placeholders if there is none
- prior, default, by hand: RMS error of the torque on another motion, relative to the torque's RMS,
  while a joint moves faster than 0.05 rad/s, where Coulomb friction is defined. By hand: the terms
  that the robot has are named
- expected: the error that the standard deviations of `by hand` imply
- bound: the error of the best estimator in the mean, if it knew motion and noise exactly (Bayesian
  Cramér-Rao bound), so that only efforts and forces were noisy
- ratio: of the prior's error to the default's
- covered: share of determined parameters, joint terms included, inside their 90 % interval
- square: mean square of their errors over their deviations, 1 if these are right
- geometry: mean square of errors of joint placements over their deviations

Links of model files are other bodies, see `draw_prior`, or with `--model-errors separate` their
masses, centres of mass and central inertias are each wrong.

With `--kinematics` the joints of an arm's model file are displaced by up to 2 mm and turned by up
to 0.3° about each axis, and their placements are estimated with the links. The bound knows them.

With `--warm-up 30` viscous friction falls by 30 % during the log, most of it in the first minutes.
The robot with the warm friction is judged; `by hand` takes friction as constant.

With `--no-foot-sensors` the logs of legged robots have no wrenches, and no option says where they
stand. Torques are judged with the true wrenches. Feet that are balls in the model then touch the
ground at their lowest points; sensors would feel forces at their centres.
"""

import argparse
import logging
from dataclasses import dataclass, replace

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from numpy.typing import NDArray
from package_robots import carrying_components, legs, load_robot, posture, standing
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.choices import KINEMATIC_ERRORS
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.prior import Kind, default_prior, draw_prior
from symbid_ros.identification.predictions.intervals import HALF_WIDTH
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.warming import NODES
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint, error_columns
from symbid_ros.signals.sensor_errors import SensorErrors
from symbid_ros.signals.sensor_samples import SensorSamples

FloatArray = NDArray[np.float64]

ARMS = "ur5", "ur10", "xarm7", "panda", "z1", "kinova"
LEGGED = "anymal", "solo12", "a1", "go2", "hyq"
FRICTION = ("absent", "absent, stated", "present", "present, stated")
RATE = 250.0  # Hz
MODEL_ERROR = 25.0  # %
SINES = 6
FREQUENCIES = (0.03, 0.6)  # Hz
LARGEST_SPEED = 1.5  # rad/s
ENCODER, GYRO, ACCELEROMETER = 2e-5, 2e-3, 2e-2  # rad, rad/s, m/s²
# Of efforts by the largest effort, and of the feet's forces by the weight.
EFFORT, FORCE = 1e-3, 1e-3
UNKNOWN = 1e3  # of forces that nothing measures, by the weight
LARGEST = 5.0  # times the RMS effort; files state limits of 1000 Nm for small drives
SLIPS = 0.05  # rad/s; Coulomb friction of slower joints is undefined
LEVER = 0.1  # m; noise of a foot's moments over that of its forces
TILT, SHIFT = 0.12, 0.025  # of a standing base: rad and m
# Heights, m, by which a standing base is lowered until legs, which are straight in some files, bend
# so far that no joint is faster, rad/s.
LOWERED, LARGEST_STANDING = (0.0, 0.05, 0.1), 5.0
SWING = 0.5  # rad or m; of joints that are not in legs
WARM_UP = 120.0  # s; time constant


@dataclass(frozen=True)
class Setup:
    """A log's length (s), rate (Hz) and effort noise as a share of the largest effort.

    ``geometry`` are the errors of joint placements that the robot has. Feet may have no sensors.
    ``warm_up`` is the share of viscous friction that is lost until the end of the log.
    ``model_errors`` is the kind of errors of links in the model file.
    """

    seconds: float = 60.0
    rate: float = RATE
    effort_noise: float = EFFORT
    geometry: tuple[str, ...] = ()
    has_foot_sensors: bool = True
    warm_up: float = 0.0
    model_errors: Kind = "consistent"


@dataclass(frozen=True)
class Trial:
    """Figures of one identification; errors relative to the torque's RMS."""

    prior: float
    default: float
    by_hand: float
    expected: float
    bound: float
    errors: FloatArray
    alarms: tuple[str, ...]
    geometry: float = np.nan


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--robots", nargs="+", default=[*ARMS, *LEGGED])
    options.add_argument("--friction", nargs="+", choices=FRICTION, default=FRICTION)
    options.add_argument("--draws", type=int, default=1)
    options.add_argument("--seed", type=int, default=100)
    options.add_argument("--seconds", type=float, default=60.0)
    options.add_argument("--rate", type=float, default=RATE, help="Hz")
    options.add_argument("--effort-noise", type=float, default=100 * EFFORT, help="%%")
    options.add_argument("--kinematics", action="store_true", help="wrong joint placements")
    options.add_argument("--no-foot-sensors", action="store_true")
    options.add_argument("--warm-up", type=float, default=0.0, help="%% of viscous friction")
    options.add_argument("--model-errors", choices=("consistent", "separate"), default="consistent")
    given = options.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    geometry = KINEMATIC_ERRORS if given.kinematics else ()
    noise, feel = given.effort_noise / 100, not given.no_foot_sensors
    warm_up, errors = given.warm_up / 100, given.model_errors
    setup = Setup(given.seconds, given.rate, noise, geometry, feel, warm_up, errors)
    logging.disable(logging.WARNING)
    columns = "robot", "friction", "prior %", "default %", "by hand %", "expected %", "bound %"
    columns = *columns, "ratio", "covered", "square", "geometry", "alarms"
    print(f"| {' | '.join(columns)} |")
    print(len(columns) * "|---" + "|", flush=True)
    with threadpool_limits(1):
        for name in given.robots:
            for friction in given.friction:
                trials = [
                    trial(name, friction, given.seed + number, setup)
                    for number in range(given.draws)
                ]
                print(table_row(name, friction, trials), flush=True)


def table_row(name: str, friction: str, trials: list[Trial]) -> str:
    """Return the geometric means of the errors, and pooled coverage."""
    prior, default, by_hand, expected, bound = (
        float(np.exp(np.mean([np.log(getattr(one, field)) for one in trials])))
        for field in ("prior", "default", "by_hand", "expected", "bound")
    )
    errors = np.concatenate([one.errors for one in trials])
    geometry = np.mean([one.geometry for one in trials])
    covered = np.mean(np.abs(errors) < HALF_WIDTH)
    alarms = "; ".join(sorted({alarm[:60] for one in trials for alarm in one.alarms})) or "none"
    judged = f"{prior / default:.0f} | {covered:.2f} | {np.mean(errors**2):.2f} | {geometry:.2f}"
    return (
        f"| {name} | {friction} | {100 * prior:.2g} | {100 * default:.2g} | {100 * by_hand:.2g} | "
        f"{100 * expected:.2g} | {100 * bound:.2g} | {judged} | {alarms} |"
    )


def trial(name: str, friction: str, seed: int, setup: Setup) -> Trial:
    """Simulate a log, identify it with default options and with named terms, and judge both."""
    stated, feet = load_robot(name)
    rng = np.random.default_rng(seed)
    errors = SensorErrors.of(setup.geometry, stated, (), ())
    theta = np.sqrt(3) * errors.std * rng.uniform(-1, 1, len(errors))
    robot = errors.placed(ParameterSet(stated), theta).model
    on_balls = not setup.has_foot_sensors
    if on_balls:
        feet = balls(robot, feet)
    motion = move(robot, feet, rng, setup.seconds, setup.rate, on_balls=on_balls)
    size = np.sqrt(np.mean(torque(plain(robot), motion) ** 2, axis=0))
    size = np.maximum(size, 0.05 * size.max())
    truth = with_friction(robot, friction.startswith("present"), size, rng)
    log = record(truth, motion, size, rng, setup)
    is_stated = friction.endswith("stated")
    model = inaccurate(truth, is_stated, size, seed, rng, errors=setup.model_errors)
    model = with_placements(model, stated)
    terms = "viscous,coulomb,armature" if friction.startswith("present") else "none"
    found = sy.identify(model, log, sensor_errors=setup.geometry)
    by_hand = sy.identify(
        model, log, joint_terms=(terms,), no_holdout=True, sensor_errors=setup.geometry
    )
    other = move(robot, feet, rng, 20.0, setup.rate, on_balls=on_balls)
    other = replace(other, stamp=other.stamp + log_end(setup))  # the robot is warm
    true = torque(truth, other)
    noise = effort_deviation(truth, size, setup.effort_noise)
    force = FORCE if setup.has_foot_sensors else UNKNOWN
    slips = np.abs(other.velocity) > SLIPS
    scale = np.sqrt(np.mean(true[slips] ** 2))

    def error(values: FloatArray) -> float:
        return float(np.sqrt(np.mean((values - true)[slips] ** 2)) / scale)

    return Trial(
        error(torque(model, other)),
        error(predicted(found, other)),
        error(predicted(by_hand, other)),
        float(np.sqrt(np.mean(variance(by_hand, other)[slips])) / scale),
        float(np.sqrt(np.mean(least_variance(truth, motion, other, noise, force)[slips])) / scale),
        scores(found, truth, setup),
        found.alarms,
        placement_square(found, theta),
    )


def with_placements(robot: sy.RobotModel, other: sy.RobotModel) -> sy.RobotModel:
    """Return a robot whose joints have the placements of those of another."""
    joints = (
        replace(joint, rotation=one.rotation, translation=one.translation)
        for joint, one in zip(robot.joints, other.joints, strict=True)
    )
    return replace(robot, joints=tuple(joints))


def placement_square(found: sy.Result, theta: FloatArray) -> float:
    """Return the mean square of the errors of joint placements θ over their deviations."""
    one = found._identification
    if not len(theta):
        return float("nan")
    count = len(found.estimate.names)
    assert one.factor is not None
    std = np.linalg.norm(one.factor[count:], axis=1)
    return float(np.mean(((one.unknowns[count:] - theta) / std) ** 2))


def plain(robot: sy.RobotModel) -> sy.RobotModel:
    """Return a robot without friction and armature."""
    joints = (
        replace(joint, damping=0.0, friction_loss=0.0, armature=0.0) for joint in robot.joints
    )
    return replace(robot, joints=tuple(joints))


def with_friction(
    robot: sy.RobotModel, is_present: bool, size: FloatArray, rng: np.random.Generator
) -> sy.RobotModel:
    """Return the true robot; friction in proportion to the efforts (J,), Nm."""
    if not is_present:
        return plain(robot)
    joints = tuple(
        replace(
            joint,
            damping=0.08 * one * rng.uniform(0.5, 1.5),
            friction_loss=0.10 * one * rng.uniform(0.5, 1.5),
            armature=0.01 * one * rng.uniform(0.5, 1.5),
        )
        if joint.mimic is None
        else joint
        for joint, one in zip(plain(robot).joints, size, strict=True)
    )
    return replace(robot, joints=joints)


def inaccurate(
    truth: sy.RobotModel,
    is_stated: bool,
    size: FloatArray,
    seed: int,
    rng: np.random.Generator,
    *,
    errors: Kind = "consistent",
) -> sy.RobotModel:
    """Return the model file's robot: wrong links, and friction as the file states it."""
    links = ParameterSet(plain(truth))
    wrong = links.apply(draw_prior(links, errors, MODEL_ERROR, seed).mean)
    if not is_stated:
        return plain(wrong)
    joints = tuple(
        replace(
            joint,
            damping=(true.damping or 0.002 * one) * rng.uniform(0.5, 1.5),
            friction_loss=true.friction_loss * rng.uniform(0.5, 1.5),
            armature=true.armature * rng.uniform(0.5, 1.5),
        )
        for joint, true, one in zip(wrong.joints, truth.joints, size, strict=True)
    )
    return replace(wrong, joints=joints)


def move(
    robot: sy.RobotModel,
    feet: tuple[str, ...],
    rng: np.random.Generator,
    seconds: float,
    rate: float = RATE,
    *,
    on_balls: bool = False,
) -> Samples:
    """Return a random motion with the wrenches of the feet, and no efforts yet.

    ``on_balls`` has forces act where balls touch the ground, instead of at the feet's origins.
    """
    time = np.arange(0.0, seconds, 1 / rate)
    if not feet:
        position = robot.apply_mimics(waves(rng, time, len(robot.joints), LARGEST_SPEED / 2))
        rest = np.zeros((len(time), 3))
        return samples(time, position, rest, rest, rest - robot.gravity)
    tilted = Rotation.from_euler("xyz", waves(rng, time, 3, 1.0, TILT))
    shifted = waves(rng, time, 3, 1.0, SHIFT)
    position = np.tile(posture(robot), (len(time), 1))
    others = np.flatnonzero(~legs(robot, feet))
    position[:, others] += waves(rng, time, len(others), LARGEST_SPEED / 2, SWING)
    wanted = robot.apply_mimics(position)
    for lower in LOWERED:
        down = lower * np.array([0.0, 0.0, 1.0])
        rotation, place, position = standing(robot, feet, tilted, shifted - down, wanted)
        if np.abs(np.diff(position, axis=0)).max() * rate < LARGEST_STANDING:
            break
    else:
        raise SystemExit(f"{robot.source}: its legs are too straight to move the base")
    turn = make_interp_spline(time, rotation.as_quat(canonical=True), k=5).derivative()(time)
    # ω in base axes is twice the vector part of q⁻¹ q̇.
    omega = 2 * products(rotation.inv().as_quat(canonical=True), turn)[:, :3]
    alpha = make_interp_spline(time, omega, k=5).derivative()(time)
    upwards = np.array([0.0, 0.0, 9.81])
    world = make_interp_spline(time, place, k=5).derivative(2)(time) + upwards
    motion = samples(time, position, omega, alpha, rotation.inv().apply(world))
    motion = replace(motion, wrenches=np.zeros((len(time), len(feet), 6)), wrench_frames=feet)
    if on_balls:
        motion = replace(motion, upward=rotation.inv().apply([0.0, 0.0, 1.0]))
    owed = base_wrench(robot, motion)
    levers = held_wrenches(robot, motion)
    # Wrenches with the smallest sum of squares; each row of `effect` is that of a component.
    jacobian = contact_jacobian(robot, feet, link_poses(robot, position))
    effect = levers.transpose(0, 2, 1) @ jacobian[:, :, :6]
    shares = effect @ np.linalg.solve(effect.transpose(0, 2, 1) @ effect, owed[..., None])
    return replace(motion, wrenches=(levers @ shares).reshape(len(time), len(feet), 6))


def balls(robot: sy.RobotModel, feet: tuple[str, ...]) -> tuple[str, ...]:
    """Return the centres of the feet that are balls, and the frames of the others."""
    centers = {frame.link: frame.name for frame in robot.frames if frame.radius}
    return tuple(centers.get(robot.frame(foot).link, foot) for foot in feet)


def held_wrenches(robot: sy.RobotModel, motion: Samples) -> FloatArray:
    """Return the wrenches (N, 6 F, h) in the feet's frames of the unit components that carry."""
    held = carrying_components(motion.wrench_frames)
    wrenches = np.zeros((len(motion), 6 * len(motion.wrench_frames), len(held)))
    wrenches[:, held, np.arange(len(held))] = 1.0
    if motion.upward is None:
        return wrenches
    rotations = link_poses(robot, motion.position).rotation
    for index, frame in enumerate(map(robot.frame, motion.wrench_frames)):
        axes = rotations[:, frame.link] @ frame.rotation
        bottom = -frame.radius * np.einsum("tji,tj->ti", axes, motion.upward)
        for axis, column in enumerate(np.searchsorted(held, 6 * index + np.arange(3, 6))):
            wrenches[:, 6 * index : 6 * index + 3, column] += np.cross(bottom, np.eye(3)[axis])
    return wrenches


def waves(
    rng: np.random.Generator, time: FloatArray, count: int, speed: float, largest: float = np.inf
) -> FloatArray:
    """Return sums of sines (N, count) within a speed and an amplitude."""
    omega = 2 * np.pi * rng.uniform(*FREQUENCIES, (SINES, count))
    amplitude = rng.uniform(0.3, 1.0, (SINES, count)) / omega
    angle = time[:, None, None] * omega + rng.uniform(0, 2 * np.pi, (SINES, count))
    value = np.sum(amplitude * np.sin(angle), axis=1)
    rate = np.abs(np.sum(amplitude * omega * np.cos(angle), axis=1)).max(axis=0)
    return value * np.minimum(speed / rate, largest / np.abs(value).max(axis=0))


def samples(
    time: FloatArray, position: FloatArray, omega: FloatArray, alpha: FloatArray, force: FloatArray
) -> Samples:
    """Return a motion whose joint derivatives are those of a quintic spline."""
    spline = make_interp_spline(time, position, k=5)
    return Samples(
        stamp=np.rint(time * 1e9).astype(np.int64),
        position=position,
        velocity=spline.derivative()(time),
        acceleration=spline.derivative(2)(time),
        effort=np.zeros_like(position),
        base_angular_velocity=omega,
        base_angular_acceleration=alpha,
        base_specific_force=force,
        wrenches=np.zeros((len(time), 0, 6)),
        wrench_frames=(),
    )


def products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return products of quaternions xyzw (N, 4), of any length."""
    u, v = first[:, :3], second[:, :3]
    vector = first[:, 3:] * v + second[:, 3:] * u + np.cross(u, v)
    return np.column_stack([vector, first[:, 3] * second[:, 3] - np.sum(u * v, axis=1)])


def base_wrench(robot: sy.RobotModel, motion: Samples) -> FloatArray:
    """Return the wrench (N, 6) that moves the base without any contact."""
    parameters = ParameterSet(robot)
    return (equation_of_motion(parameters, motion).K @ parameters.values)[:, :6]


def torque(robot: sy.RobotModel, motion: Samples) -> FloatArray:
    """Return the torques (N, J) that move a robot, friction included."""
    parameters = ParameterSet(plain(robot))
    rows = equation_of_motion(parameters, motion)
    needed = (rows.K @ parameters.values - rows.y)[:, -len(robot.joints) :]
    damping, loss, armature = (
        np.array([getattr(joint, name) for joint in robot.joints])
        for name in ("damping", "friction_loss", "armature")
    )
    speed = motion.velocity
    return needed + damping * speed + loss * np.sign(speed) + armature * motion.acceleration


def cold_friction(truth: sy.RobotModel, motion: Samples, share: float) -> FloatArray:
    """Return by how much viscous friction (N, J) exceeds that at the end, Nm or N.

    ``share`` of the friction at the start is lost.
    """
    warm = np.array([joint.damping for joint in truth.joints])
    time = 1e-9 * (motion.stamp - motion.stamp[0])
    excess: FloatArray = warm * relative_excess(time, time[-1], share)[:, None] * motion.velocity
    return excess


def relative_excess(time: FloatArray, end: float, share: float) -> FloatArray:
    """Return by how much friction at times (N,), s, exceeds that at the end, over the latter."""
    left = (np.exp(-time / WARM_UP) - np.exp(-end / WARM_UP)) / (1 - np.exp(-end / WARM_UP))
    excess: FloatArray = share / (1 - share) * left
    return excess


def log_end(setup: Setup) -> int:
    """Return a stamp after a log, ns."""
    return round(1e9 * setup.seconds)


def record(
    truth: sy.RobotModel,
    motion: Samples,
    size: FloatArray,
    rng: np.random.Generator,
    setup: Setup = Setup(),
) -> sy.Log:
    """Return the noisy log of a motion of the true robot."""
    efforts = torque(truth, motion) + cold_friction(truth, motion, setup.warm_up)
    noise = effort_deviation(truth, size, setup.effort_noise)
    imus, wrenches = {}, {}
    if truth.floating:
        read = np.hstack([motion.base_angular_velocity, motion.base_specific_force])
        deviation = np.repeat([GYRO, ACCELEROMETER], 3)
        imus[truth.link_names[0]] = read + deviation * rng.normal(size=read.shape)
        weight = 9.81 * truth.phi[:, 0].sum()
        for index, foot in enumerate(motion.wrench_frames):
            moment, force = np.split(motion.wrenches[:, index], 2, axis=1)
            force = force + FORCE * weight * rng.normal(size=force.shape)
            # The moments of a point are zero, and not measured.
            if moment.any():
                moment = moment + LEVER * FORCE * weight * rng.normal(size=moment.shape)
            wrenches[foot] = np.hstack([force, moment])
    measured = [truth.joint_names.index(name) for name in truth.measured_joint_names]
    position = motion.position + ENCODER * rng.normal(size=motion.position.shape)
    efforts = efforts + noise * rng.normal(size=efforts.shape)
    return sy.Log.from_arrays(
        truth,
        time=motion.stamp,
        position=position[:, measured],
        effort=efforts[:, measured],
        imus=imus,
        wrenches=wrenches if setup.has_foot_sensors else {},
    )


def effort_deviation(truth: sy.RobotModel, size: FloatArray, share: float) -> FloatArray:
    """Return the standard deviation (J,) of the efforts' noise, Nm or N."""
    limits = np.array([joint.effort for joint in truth.joints])
    return share * np.minimum(limits, LARGEST * size)


def placed(found: sy.Result) -> ParameterSet:
    """Return the parameters of a robot with the joint placements found."""
    one, parameters = found._identification, found._parameters
    # The motion's wrenches are known.
    parameters = replace(parameters, model=replace(parameters.model, contacts=None))
    if not isinstance(one.rows, CalibratingRows):
        return parameters
    return one.rows.errors.placed(parameters, one.unknowns[len(parameters) :])


def predicted(found: sy.Result, motion: Samples) -> FloatArray:
    """Return the torques (N, J) that an identified robot needs."""
    rows = equation_of_motion(placed(found), motion)
    return (rows.K @ found.estimate.value - rows.y)[:, -motion.position.shape[1] :]


def variance(found: sy.Result, motion: Samples) -> FloatArray:
    """Return the variances (N, J) of these torques."""
    one, parameters = found._identification, found._parameters
    assert one.factor is not None
    K, factor = equation_of_motion(placed(found), motion).K, one.factor[: len(parameters)]
    # The motion is known, so biases of the IMU play no part.
    if isinstance(one.rows, CalibratingRows) and "imu_bias" not in one.rows.errors.kinds:
        factor = one.factor
        at = LinearizationPoint(found.estimate.value, one.unknowns[len(parameters) :])
        columns = error_columns(parameters, one.rows.errors, at, readings(motion))
        K = np.concatenate([K, -columns], axis=2)
    return np.sum((K[:, -motion.position.shape[1] :] @ factor) ** 2, axis=2)


def readings(motion: Samples) -> SensorSamples:
    """Return what the sensors of an arm read in a motion."""
    nothing = np.zeros((len(motion), 0, 3))
    return SensorSamples(
        stamp=motion.stamp,
        position=motion.position,
        velocity=motion.velocity,
        acceleration=motion.acceleration,
        effort=motion.effort,
        angular_velocity=nothing,
        angular_acceleration=nothing,
        specific_force=nothing,
        wrenches=motion.wrenches,
        imu_frames=(),
        wrench_frames=(),
    )


def least_variance(
    truth: sy.RobotModel, motion: Samples, other: Samples, noise: FloatArray, force: float = FORCE
) -> FloatArray:
    """Return the least mean variances (N, J) of the torques of another motion.

    The log's motion is known; efforts have the noise (J,), the feet's forces that share of the
    weight.
    """
    links = ParameterSet(plain(truth))
    L = default_prior(links).covariance_factor()
    has_friction = any(joint.damping for joint in truth.joints)
    first = 6 * truth.floating

    def columns(each: Samples) -> FloatArray:
        K = equation_of_motion(links, each).K @ L
        if not has_friction:
            return K
        factors = each.velocity, np.sign(each.velocity), each.acceleration
        # Joints that follow others have no friction of their own.
        free = [joint for joint in range(len(noise)) if joint not in truth.followers]
        terms = np.zeros((*K.shape[:2], 3 * len(free)))
        for number, factor in enumerate(factors):
            for place, joint in enumerate(free):
                terms[:, first + joint, number * len(free) + place] = factor[:, joint]
        return np.concatenate([K, terms], axis=2)

    covariance = np.zeros((len(motion), truth.dof, truth.dof))
    covariance[:, first:, first:] = np.diag(noise**2)
    if motion.wrench_frames:
        jacobian = contact_jacobian(truth, motion.wrench_frames, link_poses(truth, motion.position))
        held = carrying_components(motion.wrench_frames)
        deviation = force * 9.81 * truth.phi[:, 0].sum() * np.where(np.mod(held, 6) < 3, LEVER, 1.0)
        shares = held_wrenches(truth, motion).transpose(0, 2, 1) @ jacobian * deviation[:, None]
        covariance += shares.transpose(0, 2, 1) @ shares
    # Joints that follow others have no equation of their own.
    own = np.setdiff1d(np.arange(truth.dof), first + np.array(list(truth.followers), dtype=int))
    covariance = covariance[:, own[:, None], own]
    rows = np.linalg.solve(np.linalg.cholesky(covariance), columns(motion)[:, own])
    rows = rows.reshape(-1, rows.shape[2])
    precision = rows.T @ rows
    # Friction and armature are known from the log alone.
    count = L.shape[1]
    precision[range(count), range(count)] += 1.0
    factor = np.linalg.inv(np.linalg.cholesky(precision)).T
    return np.sum((columns(other)[:, first:] @ factor) ** 2, axis=2)


def scores(found: sy.Result, truth: sy.RobotModel, setup: Setup) -> FloatArray:
    """Return the errors of determined parameters in standard deviations."""
    estimate = found.estimate
    links = ParameterSet(plain(truth))
    true = dict(zip(links.names, links.values.tolist(), strict=True))
    for joint in truth.joints:
        true |= {
            f"{joint.name}/viscous": joint.damping,
            f"{joint.name}/coulomb": joint.friction_loss,
            f"{joint.name}/armature": joint.armature,
        }
        for percent in NODES:
            time = np.array([percent / 100 * setup.seconds])
            excess = joint.damping * relative_excess(time, setup.seconds, setup.warm_up).item()
            true[f"{joint.name}/viscous_excess_{percent}"] = excess
    some = estimate.determined & (estimate.std > 0)
    exact = np.array([true.get(name, 0.0) for name in estimate.names])
    return (estimate.value - exact)[some] / estimate.std[some]


if __name__ == "__main__":
    main()
