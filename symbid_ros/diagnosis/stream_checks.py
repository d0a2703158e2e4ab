"""Checks of single streams, slice by slice while a log is read."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from symbid_ros.diagnosis.base_motion import BaseMotionCheck
from symbid_ros.diagnosis.effort_findings import NO_CONVERSIONS, SignConversions
from symbid_ros.diagnosis.findings import FaultSpan, Finding, Kind, Severity
from symbid_ros.diagnosis.followers import FollowerCheck
from symbid_ros.diagnosis.imu_checks import ImuCheck, QuaternionCheck
from symbid_ros.diagnosis.jitter import JitterCheck
from symbid_ros.diagnosis.joint_checks import JointCheck
from symbid_ros.diagnosis.sensor_faults import FreezeDetector, SaturationDetector
from symbid_ros.diagnosis.timing import TimingCheck
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.defects import Defect, DefectCounts, DefectError
from symbid_ros.signals.required_sensors import (
    contact_flag_faults,
    missing_imu,
    with_only_imu_frame,
    wrist_sensor_faults,
)
from symbid_ros.signals.streams import ImuStream, Slice, Streams, WrenchStream


@dataclass
class StreamChecks:
    """All checks of streams that need no equation of motion.

    Attributes
    ----------
    model : RobotModel or None
        Model whose names and limits the streams are compared with.
    timings : dict of str to TimingCheck
        Timing check of each topic.
    named : tuple of Finding
        Findings about names and frames that do not match the model.
    has_streams : bool
        Whether every topic had messages in at least one slice.
    joint_topic, imu_topics : str and tuple of str
        Topics of the first such slice.
    wrench_topics : dict of str to str
        Its topics of wrenches, by frame.
    conversions : SignConversions
        What the user's options have changed in its efforts and wrenches.
    """

    model: RobotModel | None
    timings: dict[str, TimingCheck] = field(default_factory=dict)
    named: tuple[Finding, ...] = ()
    has_streams: bool = False
    joint_topic: str = ""
    imu_topics: tuple[str, ...] = ()
    wrench_topics: dict[str, str] = field(default_factory=dict)
    conversions: SignConversions = NO_CONVERSIONS
    _quaternion_checks: dict[str, QuaternionCheck] = field(default_factory=dict)
    _imu_checks: dict[str, ImuCheck] = field(default_factory=dict)
    _base_checks: dict[str, BaseMotionCheck] = field(default_factory=dict)
    _joint_check: JointCheck | None = None
    _follower_check: FollowerCheck | None = None
    _jitter_checks: dict[str, JitterCheck] = field(default_factory=dict)
    _freeze_detector: FreezeDetector = field(default_factory=FreezeDetector)
    _saturation_detector: SaturationDetector = field(default_factory=SaturationDetector)
    _defects: tuple[DefectCounts, ...] = ()
    _faults: list[str] = field(default_factory=list)
    _silent: list[FaultSpan] = field(default_factory=list)

    def take(self, piece: Slice) -> None:
        """Check the next slice of the log."""
        self._defects = piece.tallies
        for topic, stamps in piece.stamps.items():
            timing = self.timings.setdefault(topic, TimingCheck(topic))
            for part, each in enumerate(piece.split_stamps.get(topic, (stamps,))):
                timing.add(each, piece.recording, part)
        if piece.streams is None:
            self._faults.append(piece.fault)
            self._silent.append(FaultSpan(Kind.SILENT, "", piece.start, piece.stop))
            return
        streams, during = piece.streams, (piece.start, piece.stop)
        differentiated = {pose.topic for pose in streams.poses}  # no sensor has these gains
        for imu in streams.imus:
            self._quaternion_checks.setdefault(imu.topic, QuaternionCheck(imu.topic)).add(piece)
            if imu.topic not in differentiated:
                self._imu_checks.setdefault(imu.topic, ImuCheck(imu.topic)).add(imu)
            if self.model is not None:
                base = self._base_checks.setdefault(imu.topic, BaseMotionCheck(imu.topic))
                base.add(imu, self.model, during)
        if self._joint_check is None:
            self._joint_check = JointCheck(
                streams.joints.topic, streams.joints.names, is_arrays=streams.is_arrays
            )
        self._joint_check.add(streams.joints, during)
        if self.model is not None and self._follower_check is None:
            self._follower_check = FollowerCheck(streams.joints.topic, self.model)
        if self._follower_check is not None:
            self._follower_check.add(streams.joints, during)
        topic = streams.joints.topic
        self._jitter_checks.setdefault(topic, JitterCheck(topic)).add(streams.joints, during)
        self._freeze_detector.add(streams, during)
        self._saturation_detector.add(streams, during)
        if self.model is not None and not self.has_streams:
            self.named = tuple(check_names(streams, self.model))
        if not self.has_streams:
            self.joint_topic = streams.joints.topic
            self.imu_topics = tuple(imu.topic for imu in streams.imus)
            self.wrench_topics = {one.frame_id: one.topic for one in streams.wrenches}
            self.conversions = SignConversions(
                streams.joints.effort_scale,
                frozenset(one.frame_id for one in streams.wrenches if one.is_flipped),
            )
        self.has_streams = True

    def unit_findings(self) -> list[Finding]:
        """Return findings about units, gravity, velocities and missing joint values."""
        units = [one for each in self._imu_checks.values() for one in each.findings()]
        return units + (self._joint_check.findings(self.model) if self._joint_check else [])

    def findings(self, source: str) -> list[Finding]:
        """Return all findings about the streams of a log."""
        known = [timing for timing in self.timings.values() if timing.first is not None]
        first = min((timing.first or 0 for timing in known), default=0)
        last = max((timing.last or 0 for timing in known), default=0)
        limited = self._limited
        return [
            *self._silence_findings(source),
            *repair_findings(self._defects),
            *(one for timing in self.timings.values() for one in timing.findings(first, last)),
            *(one for each in self._jitter_checks.values() for one in each.findings()),
            *self._freeze_detector.findings(limited),
            *self._saturation_detector.findings(),
            *(one for each in self._quaternion_checks.values() for one in each.findings()),
            *(one for each in self._base_checks.values() for one in each.findings()),
            *self.unit_findings(),
            *(self._follower_check.findings() if self._follower_check else ()),
            *self.named,
        ]

    @property
    def spans(self) -> tuple[FaultSpan, ...]:
        """When topics had no usable messages, in the order of time."""
        found = [one for timing in self.timings.values() for one in timing.spans]
        found += [*self._silent, *self._freeze_detector.spans(self._limited)]
        return tuple(sorted(found, key=lambda one: (one.start, one.stop)))

    @property
    def _limited(self) -> set[tuple[str, str]]:
        """Saturated channels."""
        return {(topic, name) for topic, name, _ in self._saturation_detector.limits}

    def _silence_findings(self, source: str) -> list[Finding]:
        if not self._faults:
            return []
        return [
            Finding(
                Kind.SILENT,
                "",
                Severity.WARNING if self.has_streams else Severity.UNUSABLE,
                f"{self._faults[0] or source}; {len(self._faults)} slices of the log are not used; "
                "check the driver and its clock",
                {"slices": len(self._faults)},
            )
        ]


def unusable(findings: Iterable[Finding]) -> Sequence[Finding]:
    """Return the findings that make a log unusable."""
    return [one for one in findings if one.severity is Severity.UNUSABLE]


def without_other_robots(unknown: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return unknown joints without those of further robots of the same model.

    Their names are a prefix, such as ``right_``, and the name of each joint of the model.
    """
    if not joints:
        return list(unknown)
    first, *_ = joints
    prefixes = [name.removesuffix(first) for name in unknown if name.endswith(first)]
    robots = [{f"{prefix}{joint}" for joint in joints} for prefix in prefixes]
    others = set().union(*(robot for robot in robots if robot <= set(unknown)))
    return [name for name in unknown if name not in others]


def check_names(streams: Streams, model: RobotModel) -> list[Finding]:
    """Return findings for joint names and frames that do not match the model."""
    joints = streams.joints
    found = []
    missing = [name for name in model.measured_joint_names if name not in joints.names]
    if missing:
        found.append(
            Finding(
                Kind.MISSING_JOINT,
                joints.topic,
                Severity.UNUSABLE,
                f"{joints.topic}: lacks {', '.join(missing)} of model {model.source}; if the log "
                "names them otherwise, `symbid init` finds the names and writes a robot file; "
                "otherwise record all joints, or use the model of this robot",
                {"joints": len(missing)},
            )
        )
    unknown = [name for name in joints.names if name not in model.joint_names]
    unknown = without_other_robots(unknown, model.measured_joint_names)
    if unknown:
        found.append(
            Finding(
                Kind.UNKNOWN_JOINT,
                joints.topic,
                Severity.WARNING,
                f"{joints.topic}: has {', '.join(unknown)}, which model {model.source} lacks and "
                "treats as rigid; use a model with all moving joints",
                {"joints": len(unknown)},
            )
        )
    streams, warning = with_only_imu_frame(streams, model)
    if warning:
        topic = streams.imus[0].topic
        found.append(Finding(Kind.UNKNOWN_FRAME, topic, Severity.WARNING, warning))
    sensors: list[ImuStream | WrenchStream] = [
        *(streams.imus if model.floating else ()),
        *streams.wrenches,
    ]
    for sensor in sensors:
        try:
            model.frame(sensor.frame_id)
        except ModelError as error:
            found.append(
                Finding(
                    Kind.UNKNOWN_FRAME,
                    sensor.topic,
                    Severity.UNUSABLE,
                    f"{sensor.topic}: {error}; or write "
                    + robot_file_line("rename_frame", f"{sensor.frame_id}:=NAME"),
                )
            )
    found += [
        Finding(Kind.UNKNOWN_FRAME, "", Severity.UNUSABLE, f"{streams.source}: {fault}")
        for fault in (*wrist_sensor_faults(streams, model), *contact_flag_faults(streams, model))
    ]
    if fault := missing_imu(streams, model):
        text = f"{streams.source}: {fault}"
        found.append(Finding(Kind.SILENT, "", Severity.UNUSABLE, text))
    return found


KINDS = {
    Defect.DISORDER: Kind.DISORDER,
    Defect.DUPLICATE: Kind.DUPLICATE,
    Defect.NOT_FINITE: Kind.NOT_FINITE,
    Defect.SPIKE: Kind.SPIKE,
    Defect.UNKNOWN_JOINT: Kind.UNKNOWN_JOINT,
    Defect.OTHER_JOINTS: Kind.UNKNOWN_JOINT,
    Defect.REORDERED_JOINTS: Kind.REORDERED_JOINTS,
    Defect.NO_NAMES: Kind.MISSING_JOINT,
    Defect.NO_ORIENTATION: Kind.QUATERNION_NORM,
    Defect.LATE: Kind.DISORDER,
    Defect.OTHER_LAYOUT: Kind.LAYOUT,
    Defect.CLOCK_JUMP: Kind.CLOCK_JUMP,
    Defect.OTHER_FRAME: Kind.UNKNOWN_FRAME,
    Defect.ABSENT: Kind.NOT_FINITE,
    Defect.NAMED_TWICE: Kind.UNKNOWN_JOINT,
}
REMEDIES = {
    Defect.DISORDER: "use one publisher for each sensor",
    Defect.DUPLICATE: "set a new stamp on every message in the driver",
    Defect.NOT_FINITE: "repair the driver",
    Defect.SPIKE: "check the sensor, its cable and its driver for dropouts and bit errors",
    Defect.UNKNOWN_JOINT: "publish all joints from one driver",
    Defect.OTHER_JOINTS: "if the robot has these too, have their driver publish on its own topic",
    Defect.REORDERED_JOINTS: "publish all joints from one driver",
    Defect.NO_ORIENTATION: "fill it in every message, or mark it absent in every message",
    Defect.LATE: "synchronize the clocks, or record the topics together",
    Defect.OTHER_LAYOUT: "all are used, but reading is slow",
}


def repair_findings(defects: Iterable[DefectCounts]) -> list[Finding]:
    """Return a warning for each kind of repaired or skipped message, by topic."""
    return [
        Finding(
            KINDS[defect],
            counts.topic,
            Severity.WARNING,
            f"{counts.topic}: {count} of {counts.messages} messages {counts.description(defect)}; "
            f"{REMEDIES[defect]}",
            {"messages": count, "share": count / max(counts.messages, 1)},
        )
        for counts in defects
        for defect, count in counts.counts.items()
    ]


def fatal_finding(error: DefectError) -> Finding:
    """Return the finding for an error that stopped the reading of a log."""
    return Finding(KINDS[error.defect], error.topic, Severity.UNUSABLE, str(error))
