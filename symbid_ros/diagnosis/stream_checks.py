"""The checks of a log's streams, each by itself, slice by slice as the log is read."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.diagnosis.freezing import Freezing
from symbid_ros.diagnosis.inertial import Inertial
from symbid_ros.diagnosis.joint_motion import JointMotion
from symbid_ros.diagnosis.mending import mended
from symbid_ros.diagnosis.naming import check_names
from symbid_ros.diagnosis.orientation import Orientation
from symbid_ros.diagnosis.saturation import Saturation
from symbid_ros.diagnosis.timing import Timing
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.defects import Tally
from symbid_ros.signals.slices import Slice


@dataclass
class StreamChecks:
    """Everything that is checked of streams without the equation of motion.

    Attributes
    ----------
    model : RobotModel or None
        Whose names and limits they are compared with.
    timings : dict of str to Timing
        By topic.
    named : tuple of Finding
        What is wrong with names and frames under the model.
    has_streams : bool
        Whether there was a slice in which no topic was silent.
    joint_topic, imu_topics, wrench_topics : str and tuples of str
        The topics of that slice.
    """

    model: RobotModel | None
    timings: dict[str, Timing] = field(default_factory=dict)
    named: tuple[Finding, ...] = ()
    has_streams: bool = False
    joint_topic: str = ""
    imu_topics: tuple[str, ...] = ()
    wrench_topics: tuple[str, ...] = ()
    _orientations: dict[str, Orientation] = field(default_factory=dict)
    _inertials: dict[str, Inertial] = field(default_factory=dict)
    _motion: JointMotion | None = None
    _freezing: Freezing = field(default_factory=Freezing)
    _saturation: Saturation = field(default_factory=Saturation)
    _tallies: tuple[Tally, ...] = ()
    _faults: list[str] = field(default_factory=list)

    def take(self, piece: Slice) -> None:
        """Check the slice of the log that follows."""
        self._tallies = piece.tallies
        for topic, stamps in piece.stamps.items():
            self.timings.setdefault(topic, Timing(topic)).add(stamps)
        if piece.streams is None:
            self._faults.append(piece.fault)
            return
        streams, during = piece.streams, (piece.start, piece.stop)
        for imu in streams.imus:
            self._orientations.setdefault(imu.topic, Orientation(imu.topic)).add(piece)
            self._inertials.setdefault(imu.topic, Inertial(imu.topic)).add(imu)
        if self._motion is None:
            self._motion = JointMotion(streams.joints.topic, streams.joints.names)
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
