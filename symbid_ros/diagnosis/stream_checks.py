"""The checks of a log's streams, each by itself, slice by slice as the log is read."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.imu_checks import ImuCheck, QuaternionCheck
from symbid_ros.diagnosis.joint_checks import JointCheck
from symbid_ros.diagnosis.sensor_faults import FreezeDetector, SaturationDetector
from symbid_ros.diagnosis.timing import TimingCheck
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.defects import Defect, DefectCounts, DefectError
from symbid_ros.signals.streams import ImuStream, Slice, Streams, WrenchStream


@dataclass
class StreamChecks:
    """Everything that is checked of streams without the equation of motion.

    Attributes
    ----------
    model : RobotModel or None
        Whose names and limits they are compared with.
    timings : dict of str to TimingCheck
        By topic.
    named : tuple of Finding
        What is wrong with names and frames under the model.
    has_streams : bool
        Whether there was a slice in which no topic was silent.
    joint_topic, imu_topics, wrench_topics : str and tuples of str
        The topics of that slice.
    """

    model: RobotModel | None
    timings: dict[str, TimingCheck] = field(default_factory=dict)
    named: tuple[Finding, ...] = ()
    has_streams: bool = False
    joint_topic: str = ""
    imu_topics: tuple[str, ...] = ()
    wrench_topics: tuple[str, ...] = ()
    _orientations: dict[str, QuaternionCheck] = field(default_factory=dict)
    _inertials: dict[str, ImuCheck] = field(default_factory=dict)
    _motion: JointCheck | None = None
    _freezing: FreezeDetector = field(default_factory=FreezeDetector)
    _saturation: SaturationDetector = field(default_factory=SaturationDetector)
    _tallies: tuple[DefectCounts, ...] = ()
    _faults: list[str] = field(default_factory=list)

    def take(self, piece: Slice) -> None:
        """Check the slice of the log that follows."""
        self._tallies = piece.tallies
        for topic, stamps in piece.stamps.items():
            self.timings.setdefault(topic, TimingCheck(topic)).add(stamps)
        if piece.streams is None:
            self._faults.append(piece.fault)
            return
        streams, during = piece.streams, (piece.start, piece.stop)
        for imu in streams.imus:
            self._orientations.setdefault(imu.topic, QuaternionCheck(imu.topic)).add(piece)
            self._inertials.setdefault(imu.topic, ImuCheck(imu.topic)).add(imu)
        if self._motion is None:
            self._motion = JointCheck(streams.joints.topic, streams.joints.names)
        self._motion.add(streams.joints, during)
        self._freezing.add(streams, during)
        self._saturation.add(streams, during)
        if self.model is not None and not self.has_streams:
            self.named = tuple(check_names(streams, self.model))
        if not self.has_streams:
            self.joint_topic = streams.joints.topic
            self.imu_topics = tuple(imu.topic for imu in streams.imus)
            self.wrench_topics = tuple(wrench.topic for wrench in streams.wrenches)
        self.has_streams = True

    def unit_findings(self) -> list[Finding]:
        """Return what is wrong with units, gravity, velocities and what joints leave out."""
        units = [one for each in self._inertials.values() for one in each.findings()]
        return units + (self._motion.findings(self.model) if self._motion else [])

    def findings(self, source: str) -> list[Finding]:
        """Return all that is wrong with the streams of a log of that name."""
        known = [timing for timing in self.timings.values() if timing.first is not None]
        first = min((timing.first or 0 for timing in known), default=0)
        last = max((timing.last or 0 for timing in known), default=0)
        limited = {(topic, name) for topic, name, _ in self._saturation.limits}
        return [
            *self._silent(source),
            *mended(self._tallies),
            *(one for timing in self.timings.values() for one in timing.findings(first, last)),
            *self._freezing.findings(limited),
            *self._saturation.findings(),
            *(one for each in self._orientations.values() for one in each.findings()),
            *self.unit_findings(),
            *self.named,
        ]

    def _silent(self, source: str) -> list[Finding]:
        if not self._faults:
            return []
        return [
            Finding(
                Kind.SILENT,
                "",
                Severity.WARNING if self.has_streams else Severity.UNUSABLE,
                f"{self._faults[0] or source}; {len(self._faults)} slices of the log are left out, "
                "check the driver and its clock",
                {"slices": len(self._faults)},
            )
        ]


def unusable(findings: Iterable[Finding]) -> Sequence[Finding]:
    """Return the findings that make a log unusable."""
    return [one for one in findings if one.severity is Severity.UNUSABLE]


def check_names(streams: Streams, model: RobotModel) -> list[Finding]:
    """Compare joint names and frames with a model's."""
    joints = streams.joints
    found = []
    missing = [name for name in model.measured_joint_names if name not in joints.names]
    if missing:
        found.append(
            Finding(
                Kind.MISSING_JOINT,
                joints.topic,
                Severity.UNUSABLE,
                f"{joints.topic}: lacks {', '.join(missing)} of model {model.source}; record all "
                "of its joints or give the model of this robot",
                {"joints": len(missing)},
            )
        )
    unknown = [name for name in joints.names if name not in model.joint_names]
    if unknown:
        found.append(
            Finding(
                Kind.UNKNOWN_JOINT,
                joints.topic,
                Severity.WARNING,
                f"{joints.topic}: names {', '.join(unknown)}, which model {model.source} does not "
                "have: taken to be rigid; give a model that has what moves",
                {"joints": len(unknown)},
            )
        )
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
                    Kind.UNKNOWN_FRAME, sensor.topic, Severity.UNUSABLE, f"{sensor.topic}: {error}"
                )
            )
    if model.floating and not streams.imus:
        found.append(
            Finding(
                Kind.SILENT,
                "",
                Severity.UNUSABLE,
                f"{streams.source}: the base of {model.source} floats, but no topic is of type "
                "sensor_msgs/msg/Imu; record the IMU, or give `base` fixed if it is bolted down",
            )
        )
    return found


KINDS = {
    Defect.DISORDER: Kind.DISORDER,
    Defect.DUPLICATE: Kind.DUPLICATE,
    Defect.NOT_FINITE: Kind.NOT_FINITE,
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
    Defect.DISORDER: "let one publisher speak for one sensor",
    Defect.DUPLICATE: "let the driver stamp every message anew",
    Defect.NOT_FINITE: "repair the driver",
    Defect.UNKNOWN_JOINT: "let one driver speak for all joints",
    Defect.OTHER_JOINTS: "if the robot has these too, let one driver speak for all joints",
    Defect.REORDERED_JOINTS: "let one driver speak for all joints",
    Defect.NO_ORIENTATION: "let the driver fill it always or mark it absent always",
    Defect.LATE: "stop the clocks from drifting apart, or record the topics together",
    Defect.OTHER_LAYOUT: "none is lost; reading is slow",
}


def mended(tallies: Iterable[DefectCounts]) -> list[Finding]:
    """Return what was mended in each topic."""
    return [
        Finding(
            KINDS[defect],
            tally.topic,
            Severity.WARNING,
            f"{tally.topic}: {count} of {tally.messages} messages {tally.description(defect)}; "
            f"{REMEDIES[defect]}",
            {"messages": count, "share": count / max(tally.messages, 1)},
        )
        for tally in tallies
        for defect, count in tally.counts.items()
    ]


def beyond_mending(error: DefectError) -> Finding:
    """Return the finding that ended the reading of a log."""
    return Finding(KINDS[error.defect], error.topic, Severity.UNUSABLE, str(error))
