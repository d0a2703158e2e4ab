"""A recording as aligned stretches, read piece by piece as often as they are wanted."""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from symbid_ros.diagnosis.findings import Finding
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import moving_segments, warned_once
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment, cut_to
from symbid_ros.signals.weak_form import BLOCK

# Slices are of whole blocks, over which no window reaches: where they are cut makes no difference.
SPAN = 15 * BLOCK
# Bytes of aligned channels that are kept rather than read again: five minutes of Symbitron.
MOST_KEPT = 128 << 20

logger = logging.getLogger(__name__)


class AlignedLog:
    """The stretches of a recording at which every sensor spoke; iterate as often as needed.

    Parameters
    ----------
    log : Log
        Read piece by piece.
    model : RobotModel
        Kinematics and frames.
    span : int
        Length of the slices that are in memory at a time, ns.
    most_kept : int
        Bytes of stretches that are kept rather than read again.
    checks : StreamChecks, optional
        Takes every slice as it is read for the first time. It says what is wrong with the streams,
        so that reading warns of nothing but what is left out.

    Raises
    ------
    BagError, DataError, ModelError
        While iterating, when a bag, its data or the model does not serve.
    """

    def __init__(
        self,
        log: Log,
        model: RobotModel,
        *,
        span: int = SPAN,
        most_kept: int = MOST_KEPT,
        checks: StreamChecks | None = None,
    ) -> None:
        self._log, self._model = log, model
        self._span, self._most_kept = span, most_kept
        self._checks = checks
        self._kept: tuple[Segment, ...] | None = None
        self._has_been_read = False

    def __iter__(self) -> Iterator[Segment]:
        if self._kept is not None:
            yield from self._kept
            return
        kept: list[Segment] | None = []
        for segment in self._read(warn=not self._has_been_read):
            if kept is not None:
                kept.append(segment)
                if sum(one.nbytes for one in kept) > self._most_kept:
                    kept = None
            yield segment
        self._has_been_read = True
        self._kept = None if kept is None else tuple(kept)

    def whole_stretches(self) -> tuple[Segment, ...]:
        """Return the stretches as long as they are, all at once."""
        whole: list[Segment] = []
        for segment in self:
            if whole and whole[-1].is_continued_by(segment):
                whole[-1] = whole[-1].joined(segment)
            else:
                whole.append(segment)
        return tuple(whole)

    def _read(self, *, warn: bool) -> Iterator[Segment]:
        checks = self._checks if warn else None
        tell = warn and checks is None
        coverage = _Coverage(self._log.source)
        told: set[tuple[str, str]] = set()
        with warned_once(muted=not tell):
            for piece in self._log.slices(self._span, warn=tell):
                if checks is not None:
                    checks.take(piece)
                if piece.streams is None:
                    coverage.lose(DataError(piece.fault))
                    continue
                streams, findings = mask_faulty_messages(piece.streams)
                if tell:
                    _warn_once(findings, told)
                try:
                    segments = moving_segments(streams, self._model)
                except DataError as error:
                    coverage.lose(error)
                    continue
                for segment in cut_to(segments, piece.start, piece.stop):
                    coverage.take(segment)
                    yield segment
        coverage.check(warn=warn)


@dataclass
class _Coverage:
    """How much of a recording is in its stretches."""

    source: str
    first: Segment | None = None
    until: int = 0
    instants: int = 0
    faults: list[DataError] = field(default_factory=list)

    def take(self, segment: Segment) -> None:
        if self.first is None:
            self.first = segment
        elif segment.frames != self.first.frames:
            raise DataError(
                f"{self.source}: header.frame_id of a sensor changes from "
                f"{', '.join(self.first.frames)} to {', '.join(segment.frames)}; give each run "
                "separately"
            )
        self.until = int(segment.stamp[-1])
        self.instants += len(segment)

    def lose(self, fault: DataError) -> None:
        self.faults.append(fault)

    def check(self, *, warn: bool) -> None:
        """Refuse a recording without any stretch, and tell what is left out of another."""
        if self.first is None:
            raise (
                self.faults[0]
                if self.faults
                else DataError(
                    f"{self.source}: holds nothing of the time asked for; give an earlier start"
                )
            )
        if not warn:
            return
        for fault in self.faults[:1]:
            logger.warning("%s; %d slices of the log are left out", fault, len(self.faults))
        length = (self.until - int(self.first.stamp[0])) * 1e-9
        expected = round(length * self.first.rate) + 1
        if self.instants < expected:
            logger.warning(
                "%s: %d of %d instants lie in gaps and are left out",
                self.source,
                expected - self.instants,
                expected,
            )


def _warn_once(findings: Iterable[Finding], told: set[tuple[str, str]]) -> None:
    """Say of each kind and topic once that its messages are left out."""
    for finding in findings:
        if (finding.kind.value, finding.stream) not in told:
            told.add((finding.kind.value, finding.stream))
            logger.warning("%s; those messages are left out", finding.message)
