"""Checks of a log before its identification: refusals, warnings, alarms and starting points."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.choices import SensorErrorKind
from symbid_ros.diagnosis.findings import (
    OF_READINGS,
    OF_SIGNED_EFFORTS,
    FaultSpan,
    Finding,
    Kind,
    has_unsigned_efforts,
    merged,
)
from symbid_ros.diagnosis.model_checks import check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stream_checks import StreamChecks, unusable
from symbid_ros.errors import DataError, SymbidError
from symbid_ros.identification.calibration.extended_problem import Mounting
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.conventions.joint_readings import find_common_reversal, find_readings
from symbid_ros.identification.conventions.missing_inertia import (
    find_missing_inertia,
    missing_inertia_finding,
)
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

logger = logging.getLogger(__name__)

# Faults that bias an estimate although the log is usable.
BIASING = frozenset(
    {
        Kind.ACCELEROMETER_GAIN,
        Kind.GYROSCOPE_GAIN,
        Kind.BASE_MOTION,
        Kind.STAMP_RATE,
        Kind.JITTER,
        Kind.IMU_MOUNTING,
        Kind.MISSING_WRENCH,
        Kind.ENCODER_OFFSET,
        Kind.DELAY,
        Kind.EFFORT_DELAY,
        Kind.MISSING_INERTIA,
        Kind.TORQUE_GAIN,
        Kind.WRENCH_GAIN,
        Kind.WRENCH_OFFSET,
        Kind.UNSIGNED_EFFORT,
        Kind.WRIST_SENSOR,
    }
)
# Rotations of an IMU up to this angle, degrees, can be estimated with the robot.
LARGEST_MOUNTING = 30.0
# Least standard deviation of a rotation that the checks found, degrees: soles and joints give.
LEAST_MOUNTING_STD = 0.5


@dataclass(frozen=True)
class LogChecks:
    """What the checks of a log found.

    Attributes
    ----------
    findings : tuple of Finding
        Worst first.
    mountings : mapping of str to Mounting
        Rotations of IMUs to estimate from, by frame.
    spans : tuple of FaultSpan
        When topics had no usable messages.
    tares : mapping of str to Tare
        What wrench sensors of feet read in the air, by frame.
    """

    findings: tuple[Finding, ...] = ()
    mountings: Mapping[str, Mounting] = field(default_factory=dict)
    spans: tuple[FaultSpan, ...] = ()
    tares: Mapping[str, Tare] = field(default_factory=dict)

    @property
    def alarms(self) -> tuple[str, ...]:
        """Findings that bias an estimate, one line each."""
        return tuple(one.message for one in self.findings if one.kind in BIASING)

    @property
    def has_unsigned_efforts(self) -> bool:
        """Whether efforts are said to be magnitudes."""
        return has_unsigned_efforts(self.findings)


NO_CHECKS = LogChecks()


class ModelWatch:
    """Collects what a log says about the model, while it is read or later.

    Parameters
    ----------
    robot : RobotModel
        With the prior's inertias.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._statistics: ModelStatistics | None = None
        self._error: SymbidError | None = None

    def __call__(self, segment: Segment) -> None:
        """Add a segment, unless one before it was unusable."""
        if self._error is not None:
            return
        try:
            if self._statistics is None:
                frames = segment.wrench_frames, segment.imu_frames
                self._statistics = ModelStatistics(self._robot, *frames)
            self._statistics.add(segment)
        except SymbidError as error:
            self._error = error

    def statistics(self) -> ModelStatistics | None:
        """Return the statistics of all segments; an error that occurred is raised here."""
        if self._error is not None:
            raise self._error
        return self._statistics


def check_dataset(
    dataset: Dataset,
    checks: StreamChecks,
    robot: RobotModel,
    *,
    estimated: Collection[SensorErrorKind],
    has_known_units: bool = True,
    watch: ModelWatch | None = None,
) -> LogChecks:
    """Check a log by itself and against the model, and log a warning for each harmless finding.

    Those that bias an estimate become alarms (:attr:`LogChecks.alarms`).

    Parameters
    ----------
    dataset : Dataset
    checks : StreamChecks
        Of the same log.
    robot : RobotModel
        With the prior's inertias, which are trusted within ±25 %.
    estimated : collection of str
        Sensor errors that are estimated with the robot; they are not findings then: mountings
        of IMUs, delays, and offsets of wrench sensors.
    has_known_units : bool
        Whether all efforts have the unit and the sign of torques and forces. Signs that follow from
        first guesses of unknown factors are not checked.
    watch : ModelWatch, optional
        Of the same robot and log, if it has seen the segments already.

    Raises
    ------
    DataError
        When the log is unusable: a unit, sign, frame or mounting is wrong, a contact is missing, or
        a topic carries almost no information.
    """
    source = dataset.source
    of_streams = checks.findings(source)
    _refuse_unusable(source, of_streams)
    statistics = _model_statistics(dataset, robot, watch)
    found: list[Finding] = []
    if statistics is not None:
        found = check_model(
            statistics,
            checks.joint_topic,
            checks.imu_topics,
            checks.wrench_topics,
            conversions=checks.conversions,
        ).findings
    if has_unsigned_efforts(of_streams):
        found = [one for one in found if one.kind not in OF_SIGNED_EFFORTS]
    elif joints := find_missing_inertia(dataset.segments, robot):
        found = [one for one in found if one.kind not in OF_READINGS]
        found.append(missing_inertia_finding(checks.joint_topic, joints))
    mountings = {}
    tares = {}
    if "wrench_offset" in estimated and statistics is not None:
        tares = {
            frame: Tare(one.mean, one.std) for frame, one in statistics.unloaded.readings().items()
        }
        found = [one for one in found if one.kind is not Kind.WRENCH_OFFSET]
    if "sensor_delay" in estimated:
        # The identification knows them better, with all other errors as unknowns.
        found = [one for one in found if one.kind is not Kind.DELAY]
    if "imu_mounting" in estimated and statistics is not None:
        frames = dict(zip(checks.imu_topics, statistics.gains.imu_frames, strict=False))
        turned = {one.stream: mounting for one in found if (mounting := _mounting(one)) is not None}
        mountings = {frames[topic]: one for topic, one in turned.items() if topic in frames}
        found = [one for one in found if one.stream not in turned or _mounting(one) is None]
        for topic, one in turned.items():
            logger.info(
                "%s: %s: its rotation by %.1f degrees is estimated with the robot",
                source,
                topic,
                np.degrees(np.linalg.norm(one.rotation)),
            )
    if not robot.floating and statistics is not None and not has_unsigned_efforts(of_streams):
        found = _with_readings(
            found, dataset, robot, checks.joint_topic, has_known_units=has_known_units
        )
    # A moving base contradicts the efforts of a fixed one.
    moving = [one for one in of_streams if one.kind is Kind.BASE_MOTION]
    _refuse_unusable(source, found, moving)
    findings = merged(of_streams, found)
    for finding in findings:
        if finding.kind in BIASING:
            continue
        left_out = finding.kind in (Kind.FROZEN, Kind.SATURATED)
        also = "; those messages are left out" if left_out else ""
        logger.warning("%s: %s%s", source, finding.message, also)
    return LogChecks(tuple(findings), mountings, checks.spans, tares)


def _model_statistics(
    dataset: Dataset, robot: RobotModel, watch: ModelWatch | None
) -> ModelStatistics | None:
    """Return what a log says about the model; None if there is no force to compare with."""
    if robot.contacts is not None:
        return None
    if watch is None:
        watch = ModelWatch(robot)
        for segment in dataset.segments:
            watch(segment)
    return watch.statistics()


def _with_readings(
    found: Sequence[Finding],
    dataset: Dataset,
    robot: RobotModel,
    topic: str,
    *,
    has_known_units: bool,
) -> list[Finding]:
    """Return findings in which wrong readings of joints replace what follows from them.

    A reversed position gives the efforts of other joints the wrong sign. Efforts that are reversed
    themselves keep their findings, which know their gains, unless all are and a finding names only
    some. Without findings, all efforts or positions may be reversed where no single joint shows it;
    that costs a fit.
    """
    segments = dataset.segments
    if any(one.kind in OF_READINGS for one in unusable(found)):
        readings = find_readings(segments, robot)
        signs = {name for one in found if one.kind is Kind.TORQUE_SIGN for name in one.figures}
        is_known = readings is not None and readings.are_positions_right
        if readings is not None and readings.are_all_efforts_reversed:
            is_known = signs.issuperset(f"{name}/gain" for name in readings.reversed_efforts)
    else:
        readings = find_common_reversal(segments, robot) if has_known_units else None
        is_known = False
    if readings is None or is_known:
        return [*found]
    return [readings.finding(topic), *(one for one in found if one.kind not in OF_READINGS)]


def _mounting(finding: Finding) -> Mounting | None:
    """Return the rotation of an IMU's mounting that a finding gives; None if it is none."""
    figures = finding.figures
    if finding.kind is not Kind.IMU_MOUNTING or "roll_deg" not in figures:
        return None
    if figures["angle_deg"] > LARGEST_MOUNTING:
        return None
    angles = [figures[f"{name}_deg"] for name in ("roll", "pitch", "yaw")]
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_rotvec()
    std = max(figures["angle_std_deg"], LEAST_MOUNTING_STD)
    return Mounting(rotation, float(np.radians(std)))


def _refuse_unusable(
    source: str, findings: Sequence[Finding], causes: Sequence[Finding] = ()
) -> None:
    wrong = unusable(findings)
    if not wrong:
        return
    wrong = [*causes, *wrong]
    others = ", ".join(f"{one.kind.value} of {one.stream or 'all'}" for one in wrong[1:])
    also = f"; also {others}" if others else ""
    raise DataError(
        f"{source}: {wrong[0].message}{also}; give `unchecked` to use the log anyway", "E517"
    )
