"""Reads a log into segments in which every sensor has data, and chains those of several logs."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from symbid_ros.arrays import concatenated
from symbid_ros.diagnosis.findings import Finding
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import DataError
from symbid_ros.identification.rows.folding_pool import read_ahead
from symbid_ros.identification.rows.reading_process import read_in_process
from symbid_ros.identification.rows.segment_store import SegmentStore
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align_checked, warn_once
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import WALL_CLOCK, Segment, cut_to, fingerprint, shift_behind
from symbid_ros.signals.streams import Slice
from symbid_ros.signals.weak_form import BLOCK

# Slices are whole blocks, and no window crosses a block, so the cuts do not change the results.
SPAN = 15 * BLOCK
# Bytes of aligned channels that are kept in memory: 45 s of the Symbitron.
MOST_KEPT = 16 << 20
MOST_SHOWN = 3  # slices that are left out, in a warning

logger = logging.getLogger(__name__)


class AlignedLog:
    """The segments of a log in which every sensor has data; iterate as often as needed.

    The log is read once.

    Parameters
    ----------
    log : Log
        Read slice by slice.
    model : RobotModel
        Kinematics and frames.
    span : int
        Length of a slice, ns; one slice is in memory at a time.
    most_kept : int
        Bytes of segments that are kept in memory; those beyond are kept in a temporary file, and
        read from the log again only if there is no room for one.
    checks : StreamChecks, optional
        Receives every slice when it is first read. It reports faults of the streams; reading then
        logs only what is left out.
    watch : callable, optional
        Receives every segment when it is first read.
    jobs : int
        With more than one, the next segment is read by a thread while one is used.
    in_process : bool
        Whether a process of its own reads the log instead.
    warns : bool
        Whether faults and what is left out are logged.

    Raises
    ------
    BagError, DataError, ModelError
        While iterating, when a bag, its data or the model is invalid.
    """

    def __init__(
        self,
        log: Log,
        model: RobotModel,
        *,
        span: int = SPAN,
        most_kept: int = MOST_KEPT,
        checks: StreamChecks | None = None,
        watch: Callable[[Segment], None] | None = None,
        jobs: int = 1,
        in_process: bool = False,
        warns: bool = True,
    ) -> None:
        self._log, self._model = log.of_robot(model), model
        self._span, self._most_kept = span, most_kept
        self._checks, self._watch, self._jobs = checks, watch, jobs
        self._in_process, self._warns = in_process, warns
        self._kept: SegmentStore | None = None
        self._has_been_read = False

    def __iter__(self) -> Iterator[Segment]:
        if self._kept is not None:
            yield from self._kept
            return
        store = SegmentStore(self._most_kept)
        segments = self._read(warn=self._warns and not self._has_been_read)
        if self._in_process:
            segments = read_in_process(self._log.source, segments, store, self._checks)
        else:
            segments = store.keep(read_ahead(segments) if self._jobs > 1 else segments)
        for segment in segments:
            if self._watch is not None and not self._has_been_read:
                self._watch(segment)
            yield segment
        self._has_been_read = True
        self._kept = store if store.is_complete else None

    def contiguous_segments(self) -> tuple[Segment, ...]:
        """Return all segments, those that continue one another joined."""
        return joined_segments(self)

    def _read(self, *, warn: bool) -> Iterator[Segment]:
        checks = self._checks if warn else None
        reports = warn and checks is None
        coverage = _Coverage(self._log.source)
        reported: set[tuple[str, str]] = set()
        with warn_once(muted=not reports):
            for piece in self._log.slices(self._span, warn=reports):
                if checks is not None:
                    checks.take(piece)
                coverage.begin(piece)
                if piece.streams is None:
                    coverage.lose(DataError(piece.fault, "E520"), piece)
                    continue
                streams, findings = mask_faulty_messages(piece.streams)
                if reports:
                    _warn_once(findings, reported)
                try:
                    segments = align_checked(streams, self._model)
                except DataError as error:
                    coverage.lose(error, piece)
                    continue
                for segment in cut_to(segments, piece.start, piece.stop):
                    coverage.take(segment, piece.recording)
                    yield segment
        coverage.check(warn=warn)


class ChainedSegments:
    """Segments of several logs, in the order of time.

    A log of a simulated clock that overlaps with one before it is moved behind all of those.

    Parameters
    ----------
    logs : sequence of iterables of Segment

    Attributes
    ----------
    spans : list of (int, int)
        First and last stamp of each moved log, in the order given, ns.

    Raises
    ------
    DataError
        When stamps of a wall clock overlap.
    """

    def __init__(self, logs: Sequence[Iterable[Segment]]) -> None:
        self.spans = spans = list[tuple[int, int]]()
        shifts, seconds = [], set[int]()
        for log in logs:
            own, ends = set[int](), list[tuple[int, int]]()
            for one in log:
                ends.append((int(one.stamp[0]), int(one.stamp[-1])))
                own |= fingerprint(one)
            (start, _), (_, stop), shift = ends[0], ends[-1], 0
            if any(start <= last and first <= stop for first, last in spans):
                if start >= WALL_CLOCK:
                    raise DataError(
                        "the stamps of two logs overlap, so that their payloads cannot be told "
                        "apart; record one after the other, with a clock that goes on, or identify "
                        "one of them without `drive_gain`, and give its `information` with the "
                        "other",
                        "E530",
                    )
                if again := seconds & own:
                    raise DataError(
                        f"{len(again)} s of two logs are the same; leave copies out", "E530"
                    )
                shift = shift_behind(start, max(last for _, last in spans))
            seconds |= own
            shifts.append(shift)
            spans.append((start + shift, stop + shift))
        order = sorted(range(len(logs)), key=lambda index: spans[index])
        self._logs = [(logs[index], shifts[index]) for index in order]

    def __iter__(self) -> Iterator[Segment]:
        for log, shift in self._logs:
            for segment in log:
                yield replace(segment, stamp=segment.stamp + shift) if shift else segment


def joined_segments(segments: Iterable[Segment]) -> tuple[Segment, ...]:
    """Return segments, those that continue one another joined."""
    joined: list[Segment] = []
    for segment in segments:
        if joined and joined[-1].is_continued_by(segment):
            joined[-1] = concatenated([joined[-1], segment])
        else:
            joined.append(segment)
    return tuple(joined)


@dataclass
class _Coverage:
    """How much of a log is in its segments."""

    source: str
    first: Segment | None = None
    last: int = 0
    instants: int = 0
    recording: int = 0
    paused: int = 0  # ns
    begins: int | None = None  # first stamp of all, ns
    faults: list[DataError] = field(default_factory=list)
    lost: list[tuple[int, int]] = field(default_factory=list)  # first and last stamp, ns

    def begin(self, piece: Slice) -> None:
        if self.begins is None and (span := _stamp_span(piece)) is not None:
            self.begins = span[0]

    def take(self, segment: Segment, recording: int) -> None:
        if recording != self.recording and self.first is not None:
            self.paused += int(segment.stamp[0]) - self.last - round(1e9 / segment.rate)
        self.recording = recording
        if self.first is None:
            self.first = segment
        elif segment.frames != self.first.frames:
            raise DataError(
                f"{self.source}: header.frame_id of a sensor changes from "
                f"{', '.join(self.first.frames)} to {', '.join(segment.frames)}; give each run "
                "separately",
                "E233",
            )
        self.last = int(segment.stamp[-1])
        self.instants += len(segment)

    def lose(self, fault: DataError, piece: Slice) -> None:
        self.faults.append(fault)
        if (span := _stamp_span(piece)) is not None:
            self.lost.append(span)

    def check(self, *, warn: bool) -> None:
        """Raise an error if there is no segment; otherwise log what is left out."""
        if self.first is None:
            raise (
                self.faults[0]
                if self.faults
                else DataError(
                    f"{self.source}: no data in the requested part; give an earlier `start`", "E519"
                )
            )
        if not warn:
            return
        for fault in self.faults[:1]:
            count = len(self.faults)
            left_out = "a slice of the log is" if count == 1 else f"{count} slices of the log are"
            logger.warning("%s; %s left out%s", fault, left_out, self._where())
        length = (self.last - int(self.first.stamp[0]) - self.paused) * 1e-9
        expected = round(length * self.first.rate) + 1
        ends = 1 + self.recording  # where resampling may lose an instant
        if self.instants < expected - ends:
            logger.warning(
                "%s: %d of %d instants lie in gaps and are left out",
                self.source,
                expected - self.instants,
                expected,
            )

    def _where(self) -> str:
        """Return when the lost slices are, for a message."""
        shown = [
            " to ".join(f"{(stamp - (self.begins or 0)) * 1e-9:.1f}" for stamp in span)
            for span in self.lost[:MOST_SHOWN]
        ]
        more = ", ..." if len(self.lost) > MOST_SHOWN else ""
        return f": {', '.join(shown)}{more} s after the first message" if shown else ""


def _stamp_span(piece: Slice) -> tuple[int, int] | None:
    """Return the first and last stamp of a slice, ns; None without messages."""
    stamps = [one for one in piece.stamps.values() if len(one)]
    if not stamps:
        return None
    return min(int(one.min()) for one in stamps), max(int(one.max()) for one in stamps)


def _warn_once(findings: Iterable[Finding], reported: set[tuple[str, str]]) -> None:
    """Log once for each kind and topic that its messages are left out."""
    for finding in findings:
        if (finding.kind.value, finding.stream) not in reported:
            reported.add((finding.kind.value, finding.stream))
            logger.warning("%s; those messages are left out", finding.message)
