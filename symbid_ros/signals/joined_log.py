"""Several logs of one robot as one, as several bags are: between recordings nothing is missing."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

from symbid_ros.errors import DataError
from symbid_ros.signals.defects import DefectCounts
from symbid_ros.signals.log import Log, require_log
from symbid_ros.signals.segments import WALL_CLOCK, shift_behind
from symbid_ros.signals.streams import Slice, Streams

T = TypeVar("T")


def as_one_log(log: object, *others: type[T]) -> Log | T:
    """Return what a user gave as one log: a log, a sequence of logs, or one of other types.

    Raises
    ------
    DataError
        When it is something else, or no log.
    """
    if not isinstance(log, list | tuple):
        require_log(log, *others)
        return log  # type: ignore[return-value]  # checked
    for one in log:
        require_log(one)
    if not log:
        raise DataError("no log is given; give at least one", "E510")
    if len({id(one) for one in log}) < len(log):
        raise DataError("the same log is given twice; leave copies out", "E530")
    return log[0] if len(log) == 1 else joined(log)


def joined(logs: Sequence[Log]) -> Log:
    """Return several recordings of one robot, in the order of time, as one log.

    Recordings with a clock that starts at zero may have the same stamps. The later ones then move
    by whole minutes.
    """
    first = logs[0]
    return Log(
        ", ".join(dict.fromkeys(one.source for one in logs)),
        tuple(file for one in logs for file in one.files),
        _read=partial(_slices, logs),
        _open=first._open,
        _frames=first.fixed_frames,
        _of_robot=lambda robot: joined([one.of_robot(robot) for one in logs]),
    )


def _slices(logs: Sequence[Log], span: int | None, warn: bool) -> Iterator[Slice]:
    """Yield the slices of all logs, one after the other."""
    end, recording = None, 0
    before: tuple[DefectCounts, ...] = ()
    for log in logs:
        shift, last = None, None
        for piece in log.slices(span, warn=warn):
            if shift is None:
                shift = _shift(log, piece.start, end)
            last = replace(
                _moved(piece, shift),
                recording=recording + piece.recording,
                tallies=(*before, *piece.tallies),
            )
            yield last
        if last is not None:
            end, recording, before = last.stop, last.recording + 1, last.tallies


def _shift(log: Log, start: int, end: int | None) -> int:
    """Return how far the stamps of a log move, ns, that begins at ``start``."""
    if end is None or start >= end:
        return 0
    if start >= WALL_CLOCK:
        raise DataError(
            f"{log.source}: its stamps begin {(end - start) * 1e-9:.3f} s before the log before it "
            "ends; give the logs in the order of time, and leave copies out",
            "E530",
        )
    return shift_behind(start, end)


def _moved(piece: Slice, shift: int) -> Slice:
    """Return a slice with all stamps moved, ns."""
    if shift == 0:
        return piece
    return replace(
        piece,
        start=piece.start + shift,
        stop=piece.stop + shift,
        streams=None if piece.streams is None else _moved_streams(piece.streams, shift),
        stamps={topic: stamp + shift for topic, stamp in piece.stamps.items()},
    )


def _moved_streams(streams: Streams, shift: int) -> Streams:
    return replace(
        streams,
        joints=replace(streams.joints, stamp=streams.joints.stamp + shift),
        imus=tuple(replace(one, stamp=one.stamp + shift) for one in streams.imus),
        wrenches=tuple(replace(one, stamp=one.stamp + shift) for one in streams.wrenches),
        flags=tuple(replace(one, stamp=one.stamp + shift) for one in streams.flags),
        driving=tuple((start + shift, stop + shift) for start, stop in streams.driving),
        poses=tuple(replace(one, stamp=one.stamp + shift) for one in streams.poses),
    )
