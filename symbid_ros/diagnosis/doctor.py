"""One look at a log, slice by slice, and the verdict on it."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from symbid_ros.bags.container.contents import bag_names
from symbid_ros.bags.streams.selection import TopicSelection
from symbid_ros.bags.streams.slices import ALL_OF_IT, Slice, TimeRange, iterate_slices
from symbid_ros.bags.streams.tally import Defect, DefectError, Tally
from symbid_ros.diagnosis.diagnosis import Diagnosis
from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.diagnosis.freezing import Freezing
from symbid_ros.diagnosis.inertial import Inertial
from symbid_ros.diagnosis.joint_motion import JointMotion
from symbid_ros.diagnosis.mending import beyond_mending, mended
from symbid_ros.diagnosis.model_checks import ModelChecks, check_model
from symbid_ros.diagnosis.model_watch import ModelWatch
from symbid_ros.diagnosis.naming import check_names
from symbid_ros.diagnosis.orientation import Orientation
from symbid_ros.diagnosis.saturation import Saturation
from symbid_ros.diagnosis.timing import Timing
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import cut_to
from symbid_ros.signals.samples import moving_segments
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream
from symbid_ros.signals.weak_form import BLOCK

SPAN = 15 * BLOCK  # ns of a log that are in memory at a time


def diagnose(
    bags: Sequence[Path],
    model: RobotModel | None = None,
    topics: TopicSelection | None = None,
    part: TimeRange = ALL_OF_IT,
) -> Diagnosis:
    """Judge a recording.

    Parameters
    ----------
    bags : sequence of Path
        Bags that continue one another.
    model : RobotModel, optional
        The robot as its maker describes it, inertias to ±25 %; streams alone are judged without.
    topics : TopicSelection, optional
        Which are the robot's sensors.
    part : TimeRange
        Which part of the recording.

    Raises
    ------
    BagError
        When there is nothing to judge: no bag, or none of the topics.
    """
    ward = _Ward(model)
    topics = topics or TopicSelection()
    if model is not None:
        topics = replace(topics, joint_names=model.joint_names)
    pieces = iterate_slices(bags, topics, span=SPAN, part=part, warn=False)
    try:
        for piece in pieces:
            ward.take(piece)
    except DefectError as error:
        ward.fatal.append(beyond_mending(error))
    except DataError as error:
        ward.fatal.append(Finding(Kind.UNREADABLE, "", Severity.UNUSABLE, str(error)))
    return ward.diagnosis(bag_names(bags))


@dataclass
class _Ward:
    """Everything that watches a log."""

    model: RobotModel | None
    timings: dict[str, Timing] = field(default_factory=dict)
    orientations: dict[str, Orientation] = field(default_factory=dict)
    inertials: dict[str, Inertial] = field(default_factory=dict)
    motion: JointMotion | None = None
    freezing: Freezing = field(default_factory=Freezing)
    saturation: Saturation = field(default_factory=Saturation)
    tallies: tuple[Tally, ...] = ()
    fatal: list[Finding] = field(default_factory=list)
    named: list[Finding] | None = None
    watch: ModelWatch | None = None
    first: Streams | None = None
    faults: list[str] = field(default_factory=list)

    def take(self, piece: Slice) -> None:
        self.tallies = piece.tallies
        for topic, stamps in piece.stamps.items():
            self.timings.setdefault(topic, Timing(topic)).add(stamps)
        if piece.streams is None:
            self.faults.append(piece.fault)
            return
        streams = piece.streams
        for imu in streams.imus:
            self.orientations.setdefault(imu.topic, Orientation(imu.topic)).add(piece)
            self.inertials.setdefault(imu.topic, Inertial(imu.topic)).add(imu)
        if self.motion is None:
            self.motion = JointMotion(streams.joints.topic, streams.joints.names)
        self.motion.add(streams.joints)
        self.freezing.add(streams, (piece.start, piece.stop))
        self.saturation.add(streams, (piece.start, piece.stop))
        if self.model is not None:
            self._hold_against(self.model, piece, streams)

    def _hold_against(self, model: RobotModel, piece: Slice, streams: Streams) -> None:
        if self.named is None:
            self.first, self.named = streams, check_names(streams, model)
            if not _unusable(self.named):
                self.watch = ModelWatch(
                    model,
                    [one.frame_id for one in streams.wrenches],
                    [one.frame_id for one in streams.imus],
                )
        if self.watch is None or self.first is None:
            return
        _check_frames(self.first, streams)
        # What is too short or shares no time is seen in the streams' own figures.
        with suppress(DataError):
            for segment in cut_to(moving_segments(streams, model), piece.start, piece.stop):
                self.watch.add(segment)

    def diagnosis(self, source: str) -> Diagnosis:
        units = [one for each in self.inertials.values() for one in each.findings()]
        units += self.motion.findings(self.model) if self.motion else []
        checks = self._checks(units)
        known = [timing for timing in self.timings.values() if timing.first is not None]
        first = min((timing.first or 0 for timing in known), default=0)
        last = max((timing.last or 0 for timing in known), default=0)
        findings = [
            *self.fatal,
            *self._silent(source),
            *mended(self.tallies),
            *(one for timing in self.timings.values() for one in timing.findings(first, last)),
            *self.freezing.findings({(topic, name) for topic, name, _ in self.saturation.limits}),
            *self.saturation.findings(),
            *(one for each in self.orientations.values() for one in each.findings()),
            *units,
            *(self.named or []),
            *checks.findings,
        ]
        return Diagnosis(
            source=source,
            streams=tuple(timing.figures for timing in self.timings.values()),
            findings=tuple(sorted(findings, key=lambda one: -one.severity)),
            figures=checks.figures,
            left_out=tuple(checks.left_out),
        )

    def _silent(self, source: str) -> list[Finding]:
        if not self.faults:
            return []
        whole = not self.orientations and not self.freezing.readings
        return [
            Finding(
                Kind.SILENT,
                "",
                Severity.UNUSABLE if whole else Severity.WARNING,
                f"{self.faults[0] or source}; {len(self.faults)} slices of the log are left out, "
                "look after the driver and its clock",
                {"slices": len(self.faults)},
            )
        ]

    def _checks(self, units: list[Finding]) -> ModelChecks:
        if self.model is None:
            return ModelChecks(left_out=["all checks against a model: none is given"])
        if self.fatal or self.watch is None or self.first is None:
            return ModelChecks(left_out=["all checks against the model: the streams do not serve"])
        if _unusable(units):
            wrong = ", ".join(dict.fromkeys(one.kind.value for one in units))
            return ModelChecks(left_out=[f"all checks against the model: they rest on {wrong}"])
        return check_model(
            self.watch,
            self.first.joints.topic,
            [one.topic for one in self.first.imus],
            {one.frame_id: one.topic for one in self.first.wrenches},
        )


def _check_frames(first: Streams, later: Streams) -> None:
    """Refuse a sensor that changes its frame from one slice to the next."""
    before: list[ImuStream | WrenchStream] = [*first.imus, *first.wrenches]
    after: list[ImuStream | WrenchStream] = [*later.imus, *later.wrenches]
    for old, new in zip(before, after, strict=True):
        if old.frame_id != new.frame_id:
            raise DefectError(
                new.topic,
                Defect.OTHER_FRAME,
                f"{later.source}: {new.topic}: header.frame_id changes from {old.frame_id} to "
                f"{new.frame_id}; give every sensor a topic of its own",
            )


def _unusable(findings: Iterable[Finding]) -> bool:
    return any(one.severity is Severity.UNUSABLE for one in findings)
