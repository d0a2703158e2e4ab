"""What a trajectory of a standing robot is designed for: its stance, limits and sensors."""

from dataclasses import replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.stance import COORDINATES, Stance
from symbid_ros.dynamics.stance_forces import smallest_forces, stance_weight
from symbid_ros.dynamics.unmeasured_contacts import with_contacts, without_contacts
from symbid_ros.errors import OptionError
from symbid_ros.excitation.clearance import Clearance
from symbid_ros.excitation.fourier import FourierSeries
from symbid_ros.excitation.limits import SECONDS_TO_SPEED, JointLimits, joint_limits
from symbid_ros.excitation.objective import ExpectedInformation
from symbid_ros.excitation.optimizer import Design
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.problem import (
    FIRST_DERIVATIVE,
    POSTURES,
    SECOND_DERIVATIVE,
    ExcitationProblem,
    known_before,
)
from symbid_ros.excitation.stance_options import contact_names, find_stance
from symbid_ros.excitation.standing_motion import StandingMotion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.tracking import effort_std, position_std

SAMPLES_PER_HARMONIC = 12  # a posture costs more here than on a fixed base
# Range of the base, to both sides, in heights and rad. Legs and contacts limit it more.
SHIFT, TURN = 0.4, 0.6
GUESSED_EFFORT = 4.0  # largest effort of a drive without a limit, over that of standing


def standing_problem(
    robot: RobotModel,
    options: ExciteOptions,
    sensors: JointSensorOptions,
    base_sensors: BaseSensorOptions,
) -> ExcitationProblem:
    """Check a robot that stands, and return what a trajectory is designed for.

    Raises
    ------
    SymbidError
        When the base is fixed, the robot cannot stand on these feet, or an option is invalid.
    """
    if not robot.floating:
        raise OptionError(
            f"{robot.source}: its base is fixed, but `feet` is given; give `base` floating, or "
            "leave `feet` out",
            "E920",
        )
    if options.joints or options.floor is not None:
        name = "joints" if options.joints else "floor"
        raise OptionError(f"`{name}` has no effect on a standing robot; leave it out", "E920")
    stance = find_stance(robot, options)
    complete = with_contacts(robot, contact_names(robot, options))
    parameters, values, factor, prior = known_before(complete, options)
    legs = stance.leg_joints.tolist()
    named = {robot.joint_names[index]: robot.joints[index] for index in legs}
    posture = dict(zip(robot.joint_names, stance.position.tolist(), strict=True))
    limits = joint_limits(named, posture, options.limits)
    driven = np.array([joint.effort > 0 for joint in robot.joints])
    limits, capacity = _with_capacity(stance, limits, driven)
    used = limits.scaled(options.position_share, options.speed_share, options.effort_share)
    used = replace(used, effort=np.where(driven[legs], used.effort, np.inf))
    moved = [index for index in legs if driven[index]]
    margin = options.sole_margin
    motion = StandingMotion(stance, used, tuple(moved), driven, options.ground_friction, margin)
    series = FourierSeries(options.period, options.harmonics)
    expected = ExpectedInformation(parameters, values, factor, np.eye(robot.dof), motion)
    coordinates = _coordinate_limits(stance, options)
    both = sensors, base_sensors
    precision = _precision(expected, stance, coordinates, both, capacity)
    clearance, unchecked = _clearance(stance, options, coordinates)
    own = [legs.index(index) for index in moved]
    return ExcitationProblem(
        options,
        sensors,
        _rows_of(limits, own),
        Design(
            series,
            replace(expected, precision=precision),
            coordinates,
            clearance,
            SAMPLES_PER_HARMONIC * options.harmonics,
            sensors.rate,
            series.period * np.ceil(options.seconds / series.period - 1e-9),
        ),
        capacity,
        unchecked,
        prior,
    )


def _coordinate_limits(stance: Stance, options: ExciteOptions) -> JointLimits:
    """Return the range, speed and acceleration of the base's coordinates."""
    half = np.repeat([SHIFT, TURN], 3)
    speed = np.repeat([options.base_speed / stance.base_position[2], options.turn_speed], 3)
    return JointLimits(
        COORDINATES, -half, half, speed, speed / SECONDS_TO_SPEED, np.full(6, np.inf)
    )


def _with_capacity(
    stance: Stance, limits: JointLimits, driven: BoolArray
) -> tuple[JointLimits, FloatArray]:
    """Return limits with remarks, and the largest effort (J,) of each joint for its noise."""
    robot = stance.model
    samples, poses = stance.samples(np.zeros((3, 1, 6)))
    plain = ParameterSet(robot)
    force = equation_of_motion(plain, samples).K @ plain.values
    torque = np.abs(smallest_forces(stance, poses, force, driven).torque[0])
    capacity = np.maximum(GUESSED_EFFORT * torque, 0.3 * GUESSED_EFFORT * torque.max())
    remarks = []
    for name, effort in zip(limits.names, limits.effort.tolist(), strict=True):
        place = robot.joint_names.index(name)
        if np.isfinite(effort):
            capacity[place] = effort
        elif driven[place]:
            remarks.append(f"{name}: noise of efforts as for a drive of {capacity[place]:.3g}")
    return replace(limits, assumed=(*limits.assumed, *remarks)), np.where(driven, capacity, 0.0)


def _rows_of(limits: JointLimits, chosen: list[int]) -> JointLimits:
    """Return the limits of some of the joints."""
    return replace(
        limits,
        names=tuple(limits.names[index] for index in chosen),
        **{
            kind: getattr(limits, kind)[chosen]
            for kind in ("lower", "upper", "speed", "acceleration", "effort")
        },
    )


def _random_motion(limits: JointLimits) -> FloatArray:
    """Return resting coordinates (3, N, 6) in the middle third of the ranges, always the same."""
    motion = np.zeros((3, POSTURES, len(limits.names)))
    motion[0] = np.random.default_rng(0).uniform(-1, 1, motion.shape[1:]) * limits.half_width / 3
    return motion


def _clearance(
    stance: Stance, options: ExciteOptions, limits: JointLimits
) -> tuple[Clearance | None, tuple[str, ...]]:
    """Return the distances between links to keep, and what is not checked."""
    if options.no_collision:
        return None, ("collisions, as `no_collision` says",)
    postures = stance.poses(_random_motion(limits)[0]).position
    found = Clearance(replace(stance.model, floating=False), options.clearance, postures)
    remarks = (*found.remarks, "distances to the ground")
    return (None if found.is_empty else found), remarks


def _precision(
    expected: ExpectedInformation,
    stance: Stance,
    limits: JointLimits,
    both: tuple[JointSensorOptions, BaseSensorOptions],
    capacity: FloatArray,
) -> FloatArray:
    """Return the precision (n, n) of one instant's rows, from the noise of all sensors.

    The noise of each reading enters the rows as the motion's own change would, averaged over
    postures. Readings that are differentiated count as in :data:`FIRST_DERIVATIVE`.

    Every joint stops when it reverses. Rows of joints with friction are left out there, and an
    identification takes coordinates that are sometimes left out as independent of the others.
    """
    robot, (sensors, base_sensors) = stance.model, both
    motion = _random_motion(limits)
    samples, _ = stance.samples(motion)
    rest = expected.rows(motion) @ expected.values
    effects: list[FloatArray] = []

    def add(deviation: float, changed: Samples) -> None:
        effects.append(deviation * (_forces(expected, changed) - rest))

    for axis in range(3):
        unit = np.eye(3)[axis]
        change = samples.base_specific_force + unit
        add(base_sensors.accelerometer_noise, replace(samples, base_specific_force=change))
        change = samples.base_angular_acceleration + unit
        deviation = FIRST_DERIVATIVE * base_sensors.gyro_noise
        add(deviation, replace(samples, base_angular_acceleration=change))
    deviations = SECOND_DERIVATIVE * position_std(sensors, robot)
    for joint in range(len(robot.joints)):
        change = samples.acceleration.copy()
        change[:, joint] += 1.0
        add(float(deviations[joint]), replace(samples, acceleration=change))
    for joint, deviation in enumerate(effort_std(sensors, capacity).tolist()):
        one = np.zeros_like(rest)
        one[:, 6 + joint] = deviation
        effects.append(one)
    measured = [name for name in stance.frames if name not in _frames(expected)]
    if measured:
        jacobian = contact_jacobian(robot, measured, link_poses(robot, samples.position))
        noise = base_sensors.wrench_std(stance_weight(stance))
        effects += list((np.tile(noise, len(measured))[:, None] * jacobian).swapaxes(0, 1))
    B = np.stack(effects, axis=2)
    used = np.arange(robot.dof)
    if expected.parameters.model.contacts is not None:
        B = without_contacts(expected.parameters.model, samples, B)
        used = expected.parameters.model.contacts.coordinates
    covariance = np.mean(B @ B.swapaxes(1, 2), axis=0)
    if {"viscous", "coulomb"} & set(expected.parameters.terms):
        is_left_out = np.arange(robot.dof) >= 6
        if expected.parameters.model.contacts is not None:  # its rows combine those of the joints
            is_left_out |= expected.parameters.model.contacts.loads.any(axis=0)
        variance = covariance.diagonal().copy()
        covariance[is_left_out], covariance[:, is_left_out] = 0.0, 0.0
        covariance[np.diag_indices(robot.dof)] = variance
    covariance = covariance[np.ix_(used, used)]
    precision = np.zeros((robot.dof, robot.dof))
    precision[np.ix_(used, used)] = np.linalg.inv(covariance)
    return precision


def _frames(expected: ExpectedInformation) -> tuple[str, ...]:
    """Return the frames of contacts without a sensor."""
    contacts = expected.parameters.model.contacts
    return () if contacts is None else contacts.frames


def _forces(expected: ExpectedInformation, samples: Samples) -> FloatArray:
    """Return the generalised forces (N, n) of a motion, contacts included."""
    links = ParameterSet(expected.joints.model)
    inertial = expected.parameters.inertial
    return np.asarray(equation_of_motion(links, samples).K @ expected.values[:inertial])
