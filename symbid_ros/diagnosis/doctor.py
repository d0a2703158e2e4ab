"""Diagnoses a log slice by slice."""

from dataclasses import dataclass, field

from symbid_ros.diagnosis.findings import (
    Diagnosis,
    Finding,
    Kind,
    ModelChecks,
    Severity,
    merged,
)
from symbid_ros.diagnosis.model_checks import TOO_SHORT, check_model, with_rotation_line
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks, fatal_finding, unusable
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align_checked, warn_once
from symbid_ros.signals.defects import Defect, DefectError
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.streams import ImuStream, Slice, Streams, WrenchStream
from symbid_ros.signals.weak_form import ALL_WINDOWS, BLOCK, check_windows, holds_window

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
    diagnoser = _LogDiagnoser(log.source, model and log.applied_to(model))
    try:
        for piece in log.slices(SPAN, warn=False):
            diagnoser.take(piece)
    except DefectError as error:
        diagnoser.fatal.append(fatal_finding(error))
    except DataError as error:
        diagnoser.fatal.append(Finding(Kind.UNREADABLE, "", Severity.UNUSABLE, str(error)))
    return diagnoser.diagnosis()


@dataclass
class _LogDiagnoser:
    """Accumulates the checks of a log.

    Attributes
    ----------
    source : str
        Name of the log, for messages.
    model : RobotModel or None
    streams : StreamChecks
    fatal : list of Finding
        What stopped the reading.
    statistics : ModelStatistics or None
        Of the segments; None before the first.
    first : Streams or None
        The first slice.
    fault : str
        Why the first slice without a segment has none.
    holds_window : bool
        Whether some segment is long enough for an identification.
    """

    source: str
    model: RobotModel | None
    streams: StreamChecks = field(init=False)
    fatal: list[Finding] = field(default_factory=list)
    statistics: ModelStatistics | None = None
    first: Streams | None = None
    fault: str = ""
    holds_window: bool = False

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
        # As an identification leaves these out; to the model they would look like other faults.
        streams, _ = mask_faulty_messages(streams)
        try:
            with warn_once(muted=True):
                segments = align_checked(streams, model)
            for segment in cut_to(segments, piece.start, piece.stop):
                check_windows(ALL_WINDOWS, segment.rate, self.source)
                if self.statistics is None:
                    frames = segment.wrench_frames, segment.imu_frames
                    self.statistics = ModelStatistics(model, *frames)
                self.statistics.add(segment)
                self.holds_window = self.holds_window or holds_window(segment, ALL_WINDOWS)
        except DataError as error:
            self.fault = self.fault or str(error)

    def diagnosis(self) -> Diagnosis:
        checks = self._checks(self.streams.unit_findings())
        frames = {} if self.first is None else {one.topic: one.frame_id for one in self.first.imus}
        of_streams = [
            with_rotation_line(one, frames[one.stream]) if one.stream in frames else one
            for one in (*self.fatal, *self.streams.findings(self.source))
        ]
        if not self.fatal and not self.streams.timings:
            text = f"{self.source}: no data in the requested part; give an earlier `start`"
            of_streams.append(Finding(Kind.SILENT, "", Severity.UNUSABLE, text))
        return Diagnosis(
            source=self.source,
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
                [self._shortage()], left_out=[f"all checks against the model: {TOO_SHORT}"]
            )
        checks = check_model(
            self.statistics,
            self.first.joints.topic,
            [one.topic for one in self.first.imus],
            self.streams.wrench_topics,
            conversions=self.streams.conversions,
        )
        if self.statistics.rows.samples < 1:
            checks.findings.append(self._shortage())
        return checks

    def _shortage(self) -> Finding:
        """Return the finding of a log without a part that is long enough for the checks."""
        if self.holds_window:
            text = f"{self.source}: {TOO_SHORT} to check forces; record longer"
            return Finding(Kind.SHORT, "", Severity.WARNING, text)
        text = self.fault or f"{self.source}: {TOO_SHORT} to identify anything; record longer"
        return Finding(Kind.SHORT, "", Severity.UNUSABLE, text)


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
