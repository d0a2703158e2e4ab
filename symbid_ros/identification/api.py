"""Functions of the Python API: identify, diagnose, compute regressors, merge."""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from symbid_ros.arrays import FloatArray
from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.diagnosis import doctor
from symbid_ros.diagnosis.findings import Diagnosis, Kind, has_unsigned_efforts
from symbid_ros.dynamics.imu import BaseMotion
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.assumed_contacts import with_assumed_contacts
from symbid_ros.identification.conventions.base_gravity import find_gravity, searches_gravity
from symbid_ros.identification.conventions.end_stops import with_found_end_stops
from symbid_ros.identification.conventions.joint_readings import JointReadings, find_readings
from symbid_ros.identification.conventions.missing_inertia import (
    find_missing_inertia,
    missing_inertia_finding,
)
from symbid_ros.identification.conventions.position_units import find_degrees
from symbid_ros.identification.loaded_problem import load_information, load_problem
from symbid_ros.identification.log_reading import first_segments
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.pipeline import identify_problem
from symbid_ros.identification.result import LogInformation, Result
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.load import as_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import chosen_options
from symbid_ros.signals.given_arrays import number_array
from symbid_ros.signals.joined_log import as_one_log
from symbid_ros.signals.log import Log

# Options that an identification sets if the log shows them.
FOUND_IN_LOGS = "contact", "gravity", "force_only", "end_stops"


@on_one_blas_thread
def identify(
    robot: RobotModel | str | Path,
    log: Log | Sequence[Log] | LogInformation,
    options: IdentifyOptions | None = None,
    **fields: Any,
) -> Result:
    """Identify the parameters of a robot.

    Parameters
    ----------
    robot : RobotModel, str or Path
        A robot, or its URDF or MJCF. Its kinematics are used, and its inertias as prior means.
    log : Log, sequence of Log, or LogInformation
        Measurements, those of several recordings in the order of time, or the information of
        earlier logs (see :func:`merge`).
    options : IdentifyOptions, optional
        Options of the identification.
    **fields
        Fields of :class:`symbid_ros.IdentifyOptions` instead, such as ``prior_percent=25``.
        ``prior`` may also be a mapping with what a ``prior.json`` holds: ``{"parameters":
        {"LINK/m": {"value": 2.3, "std": 0.2}, …}}`` with all ten parameters of each link.

    Returns
    -------
    Result
        The identified robot, in SI units: parameters with standard deviations, links, alarms, and
        the information to be merged with that of other logs.

    Raises
    ------
    BagError
        When a bag is missing or damaged, or lacks a topic.
    ModelError
        When a joint or frame of the log is not in the model, or the model has no mass.
    DataError
        When the log is unusable, such as too short, without efforts or in wrong units.
    PriorError
        When the prior is of another model.
    EstimateError, OptionError
        When nothing can be estimated, or an option is invalid.
    """
    options = chosen_options(IdentifyOptions, options, fields)
    robot = as_model(robot)
    log = as_one_log(log, LogInformation)
    if isinstance(log, LogInformation):
        problem = load_information(robot, log.observations, options)
        found = problem.with_provenance(problem.solve())
    else:
        problem = load_problem(robot, log, options)
        problem, found = identify_problem(problem)
        found_out = {name: getattr(problem.options, name) for name in FOUND_IN_LOGS}
        options = replace(options, **found_out)
    return Result(found.estimate, options, found, problem.parameters)


@on_one_blas_thread
def diagnose(
    robot: RobotModel | str | Path | None,
    log: Log | Sequence[Log],
    options: RobotOptions | None = None,
    **fields: Any,
) -> Diagnosis:
    """Check whether a log can be used to identify a robot, as ``symbid bag doctor`` does.

    Parameters
    ----------
    robot : RobotModel, str, Path or None
        The nominal robot or its file, with inertias within about 25 %; None checks each topic by
        itself.
    log : Log or sequence of Log
        Of several recordings in the order of time.
    options : RobotOptions, optional
        Mounting, wrist sensors and contacts, as of an identification.
    **fields
        These options by name instead, such as ``wrist_sensor=("tool0",)``.

    Returns
    -------
    Diagnosis
        Its ``findings`` say what is wrong, how severe that is and what to do; faults of the log are
        findings, not errors.

    Raises
    ------
    BagError
        When a bag is missing, or lacks a topic.
    ModelError
        When the model file is invalid.
    DataError
        When ``log`` is not a log.
    OptionError
        When an option is invalid.
    """
    options = chosen_options(RobotOptions, options, fields)
    robot = None if robot is None else as_model(robot)
    log = as_one_log(log)
    if robot is None:
        return doctor.diagnose(log)
    log = log.of_robot(robot)
    robot = log.applied_to(robot)
    options = with_assumed_contacts(options, robot, log)
    robot = with_robot_options(robot, options)
    found, segments = None, first_segments(log, robot)
    options = with_found_end_stops(options, robot, segments, log.source)
    robot = robot.with_end_stops(options.end_stop_joints)
    if not robot.floating and (degrees := find_degrees(segments, robot)) is not None:
        diagnosis = doctor.diagnose(log, robot)
        if any(one.kind is Kind.UNIT for one in diagnosis.findings):
            return diagnosis  # which says so
        of_streams = doctor.diagnose(log)
        left_out = "all checks against the model: they depend on unit"
        return replace(of_streams, left_out=(left_out,)).with_finding(
            degrees.finding(of_streams.streams[0].topic)
        )
    diagnosis = doctor.diagnose(log, robot)
    if robot.floating or has_unsigned_efforts(diagnosis.findings):
        return diagnosis
    if searches_gravity(options, robot):
        found = find_gravity(segments, robot)
    if found is not None:
        robot = robot.with_gravity(found.direction)
        diagnosis = doctor.diagnose(log, robot).with_finding(found.finding(robot.source))
    elif (readings := find_readings(segments, robot)) is not None:
        return _with_readings(diagnosis, readings)
    if joints := find_missing_inertia(segments, robot):
        finding = missing_inertia_finding(diagnosis.streams[0].topic, joints)
        diagnosis = diagnosis.with_readings(finding, "the inertia, which the efforts do not show")
    return diagnosis


def _with_readings(diagnosis: Diagnosis, readings: JointReadings) -> Diagnosis:
    """Return a diagnosis with wrong readings of joints."""
    finding = readings.finding(diagnosis.streams[0].topic)
    # Gains, if known, show signs of efforts together with their units.
    found = [one for one in diagnosis.findings if one.kind is Kind.TORQUE_SIGN]
    signs = {name.removesuffix("/gain") for one in found for name in one.figures}
    if readings.are_positions_right and signs.issuperset(readings.reversed_efforts):
        return diagnosis
    if readings.are_positions_right and not readings.are_all_efforts_reversed:
        return diagnosis.with_finding(finding)
    return diagnosis.with_readings(finding, "the readings of the joints")


@on_one_blas_thread
def merge(records: Sequence[LogInformation]) -> LogInformation:
    """Add up the information of several logs of one robot.

    Parameters
    ----------
    records : sequence of LogInformation
        :attr:`Result.information` of each log, or what :meth:`LogInformation.load` read.

    Returns
    -------
    LogInformation
        The sum, which :func:`identify` takes in place of a log.

    Raises
    ------
    EstimateError
        When the records differ in robot, parameters or windows, or share seconds of a log.
    DataError
        When the list is empty, or contains anything but LogInformation.
    """
    if isinstance(records, LogInformation) or any(
        not isinstance(one, LogInformation) for one in records
    ):
        raise DataError(
            "merge takes a list of LogInformation, such as Result.information of several logs",
            "E511",
        )
    if not records:
        raise DataError("merge: no records; give the information of at least one log", "E510")
    return reduce(LogInformation.merged, records)


def regressor(
    robot: RobotModel | str | Path,
    position: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    *,
    base: BaseMotion | None = None,
    options: IdentifyOptions | None = None,
) -> FloatArray:
    """Return the regressor K of the equation of motion K φ = τ + Σ Jᵀ f (thesis, Eq. 2.48).

    Parameters
    ----------
    robot : RobotModel, str or Path
        A robot or its file.
    position, velocity, acceleration : (N, J) array_like
        Joint motion in the order of ``robot.joint_names``: rad, rad/s and rad/s² (m, m/s and m/s²
        for prismatic joints). A pandas table with these columns may have them in any order. Mimic
        joints follow their leaders whatever their columns say.
    base : BaseMotion, optional
        Motion of the base in its own axes; required if the base floats.
    options : IdentifyOptions, optional
        Its ``joint_terms`` add columns if they are named.

    Returns
    -------
    (N, n, p) float64
        n coordinates: moment and force on a floating base, then the joints; p parameters, those of
        ``robot.inertial_parameters`` first. With these in SI units, K φ is in Nm and N. The row of
        a leader includes the forces of its mimic
        joints, whose rows are zero.

    Raises
    ------
    DataError
        When an array has the wrong shape, or the motion of a floating base is missing.
    """
    robot = as_model(robot)
    joints = len(robot.joints)
    given = {"position": position, "velocity": velocity, "acceleration": acceleration}
    motion = [number_array(what, one, robot.joint_names) for what, one in given.items()]
    count = motion[0].shape[0] if motion[0].ndim else 0
    if any(one.shape != (count, joints) for one in motion):
        shapes = ", ".join(str(one.shape) for one in motion)
        raise DataError(
            f"position, velocity, acceleration have shapes {shapes}; expected (N, {joints}), one "
            f"column for each joint of {robot.name}",
            "E511",
        )
    if base is None:
        if robot.floating:
            raise DataError(
                f"the base of {robot.name} floats; give its motion as base=BaseMotion(…)", "E511"
            )
        rest = np.zeros((count, 3))
        base = BaseMotion(rest, rest, rest - robot.gravity)
    moved = {what: number_array(f"base.{what}", one) for what, one in vars(base).items()}
    for what, one in moved.items():
        if one.shape != (count, 3):
            raise DataError(
                f"base.{what} has shape {one.shape}; expected {(count, 3)}, one row for each of "
                "the joint positions",
                "E511",
            )
    samples = Samples(
        stamp=np.arange(count),
        position=robot.apply_mimics(motion[0]),
        velocity=robot.apply_mimics(motion[1], rates=True),
        acceleration=robot.apply_mimics(motion[2], rates=True),
        effort=np.zeros((count, joints)),
        base_angular_velocity=moved["angular_velocity"],
        base_angular_acceleration=moved["angular_acceleration"],
        base_specific_force=moved["specific_force"],
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )
    terms = () if options is None or options.chooses_terms else options.terms
    return equation_of_motion(ParameterSet(robot, terms), samples).K
