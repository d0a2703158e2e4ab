"""One look at a log, slice by slice, and the verdict on it."""

from contextlib import suppress
from dataclasses import dataclass, field

from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity
from symbid_ros.diagnosis.model_checks import ModelChecks, check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stream_checks import StreamChecks, beyond_mending, unusable
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align_checked, warn_once
from symbid_ros.signals.defects import Defect, DefectError
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.streams import ImuStream, Slice, Streams, WrenchStream
from symbid_ros.signals.weak_form import BLOCK

SPAN = 15 * BLOCK  # ns of a log that are in memory at a time


def diagnose(log: Log, model: RobotModel | None = None) -> Diagnosis:
    """Judge a log.

    Parameters
    ----------
    log : Log
    model : RobotModel, optional
        The robot as its maker describes it, inertias to ±25 %; streams alone are judged without.

    Raises
    ------
    BagError
        When there is nothing to judge: no bag, or none of the topics.
    """
    judged = _LogDiagnoser(model)
    try:
        for piece in log.slices(SPAN, warn=False):
            judged.take(piece)
    except DefectError as error:
        judged.fatal.append(beyond_mending(error))
    except DataError as error:
        judged.fatal.append(Finding(Kind.UNREADABLE, "", Severity.UNUSABLE, str(error)))
    return judged.diagnosis(log.source)


@dataclass
class _LogDiagnoser:
    """Everything that is checked of a log."""

    model: RobotModel | None
    streams: StreamChecks = field(init=False)
    fatal: list[Finding] = field(default_factory=list)
    watch: ModelStatistics | None = None
    first: Streams | None = None

    def __post_init__(self) -> None:
        self.streams = StreamChecks(self.model)

    def take(self, piece: Slice) -> None:
        self.streams.take(piece)
        if self.model is not None and piece.streams is not None:
            self._hold_against(self.model, piece, piece.streams)

    def _hold_against(self, model: RobotModel, piece: Slice, streams: Streams) -> None:
        if self.first is None:
            self.first = streams
            if not unusable(self.streams.named):
                self.watch = ModelStatistics(
                    model,
                    [one.frame_id for one in streams.wrenches],
                    [one.frame_id for one in streams.imus],
                )
        if self.watch is None:
            return
        _check_frames(self.first, streams)
        # What is too short or shares no time is seen in the streams' own figures.
        with suppress(DataError), warn_once(muted=True):
            for segment in cut_to(align_checked(streams, model), piece.start, piece.stop):
                self.watch.add(segment)

    def diagnosis(self, source: str) -> Diagnosis:
        checks = self._checks(self.streams.unit_findings())
        findings = [*self.fatal, *self.streams.findings(source), *checks.findings]
        return Diagnosis(
            source=source,
            streams=tuple(timing.figures for timing in self.streams.timings.values()),
            findings=tuple(sorted(findings, key=lambda one: -one.severity)),
            figures=checks.figures,
            left_out=tuple(checks.left_out),
        )

    def _checks(self, units: list[Finding]) -> ModelChecks:
        if self.model is None:
            return ModelChecks(left_out=["all checks against a model: none is given"])
        if self.fatal or self.watch is None or self.first is None:
            return ModelChecks(left_out=["all checks against the model: the streams do not serve"])
        if wrong := unusable(units):
            kinds = ", ".join(dict.fromkeys(one.kind.value for one in wrong))
            return ModelChecks(left_out=[f"all checks against the model: they rest on {kinds}"])
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
                "E309",
            )
