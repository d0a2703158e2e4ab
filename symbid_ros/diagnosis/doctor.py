"""Diagnoses a log slice by slice."""

from contextlib import suppress
from dataclasses import dataclass, field

from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity, merged
from symbid_ros.diagnosis.model_checks import ModelChecks, check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stream_checks import StreamChecks, fatal_finding, unusable
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align_checked, warn_once
from symbid_ros.signals.defects import Defect, DefectError
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.streams import ImuStream, Slice, Streams, WrenchStream
from symbid_ros.signals.weak_form import BLOCK

SPAN = 15 * BLOCK  # ns of a log that are held in memory at once


def diagnose(log: Log, model: RobotModel | None = None) -> Diagnosis:
    """Check a log for faults.

    Parameters
    ----------
    log : Log
    model : RobotModel, optional
        The robot with inertias known to ±25 %; without it only the streams are checked.

    Raises
    ------
    BagError
        When no bag is given, or the bag lacks the topics.
    """
    diagnoser = _LogDiagnoser(model and log.applied_to(model))
    try:
        for piece in log.slices(SPAN, warn=False):
            diagnoser.take(piece)
    except DefectError as error:
        diagnoser.fatal.append(fatal_finding(error))
    except DataError as error:
        diagnoser.fatal.append(Finding(Kind.UNREADABLE, "", Severity.UNUSABLE, str(error)))
    return diagnoser.diagnosis(log.source)


@dataclass
class _LogDiagnoser:
    """Accumulates the checks of a log."""

    model: RobotModel | None
    streams: StreamChecks = field(init=False)
    fatal: list[Finding] = field(default_factory=list)
    statistics: ModelStatistics | None = None
    first: Streams | None = None

    def __post_init__(self) -> None:
        self.streams = StreamChecks(self.model)

    def take(self, piece: Slice) -> None:
        self.streams.take(piece)
        if self.model is None or self.model.contacts is not None or piece.streams is None:
            return
        self._add_to_statistics(self.model, piece, piece.streams)

    def _add_to_statistics(self, model: RobotModel, piece: Slice, streams: Streams) -> None:
        if self.first is None:
            self.first = streams
        if unusable(self.streams.named):
            return
        _check_frames(self.first, streams)
        # Slices that are too short or have no common time appear in the streams' figures.
        with suppress(DataError), warn_once(muted=True):
            for segment in cut_to(align_checked(streams, model), piece.start, piece.stop):
                if self.statistics is None:
                    frames = segment.wrench_frames, segment.imu_frames
                    self.statistics = ModelStatistics(model, *frames)
                self.statistics.add(segment)

    def diagnosis(self, source: str) -> Diagnosis:
        checks = self._checks(self.streams.unit_findings())
        of_streams = [*self.fatal, *self.streams.findings(source)]
        return Diagnosis(
            source=source,
            streams=tuple(timing.figures for timing in self.streams.timings.values()),
            findings=tuple(merged(of_streams, checks.findings)),
            figures=checks.figures,
            left_out=tuple(checks.left_out),
        )

    def _checks(self, units: list[Finding]) -> ModelChecks:
        if self.model is None:
            return ModelChecks(left_out=["all checks against a model: no model is given"])
        if self.model.contacts is not None:
            names = ", ".join(self.model.contacts.frames)
            return ModelChecks(
                left_out=[f"all checks against the model: the wrenches at {names} are unknown"]
            )
        if self.fatal or self.first is None or unusable(self.streams.named):
            return ModelChecks(left_out=["all checks against the model: the streams are unusable"])
        if wrong := unusable(units):
            kinds = ", ".join(dict.fromkeys(one.kind.value for one in wrong))
            return ModelChecks(left_out=[f"all checks against the model: they depend on {kinds}"])
        if self.statistics is None:
            return ModelChecks(
                left_out=[
                    "all checks against the model: every part of the log without a gap is too short"
                ]
            )
        return check_model(
            self.statistics,
            self.first.joints.topic,
            [one.topic for one in self.first.imus],
            self.streams.wrench_topics,
        )


def _check_frames(first: Streams, later: Streams) -> None:
    """Raise an error if a sensor's frame changes between slices."""
    before: list[ImuStream | WrenchStream] = [*first.imus, *first.wrenches]
    after: list[ImuStream | WrenchStream] = [*later.imus, *later.wrenches]
    for old, new in zip(before, after, strict=True):
        if old.frame_id != new.frame_id:
            raise DefectError(
                new.topic,
                Defect.OTHER_FRAME,
                f"{later.source}: {new.topic}: header.frame_id changes from {old.frame_id} to "
                f"{new.frame_id}; publish every sensor on its own topic",
                "E309",
            )
