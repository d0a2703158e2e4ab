"""Uniformly sampled segments of a log, and fingerprints of the seconds they cover."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays
from symbid_ros.errors import DataError

SECOND = 1_000_000_000  # ns
MINUTE = 60 * SECOND
# Stamps after September 2001 come from a wall clock, which shows each second once. Simulated time,
# and the clock of a computer that has not been set, start at 0 in every run.
WALL_CLOCK = SECOND * SECOND
# Shortest pause between two recordings of which one is moved behind the other, ns.
SHORTEST_PAUSE = 10 * SECOND
HELD_OUT = 0.25  # share of a log that is held out


@dataclass(frozen=True)
class Segment:
    """M uniformly spaced instants at which every sensor has a sample.

    Attributes
    ----------
    stamp : (M,) int64
        Nanoseconds.
    rate : float
        Hz.
    position, effort : (M, J) float64
        In the model's joint order. The effort of a driven joint is NaN where it was not measured.
    angular_velocity, linear_acceleration : (M, I, 3) float64
        Of each IMU, in its frame.
    wrenches : (M, F, 6) float64
        Moment and force of each wrench sensor, in its frame.
    imu_frames, wrench_frames : tuple of str
        Frames of the I IMUs and F wrench sensors.
    touching : (M, C) bool or None
        Which contacts without a sensor touch something; None if all may.
    stopped : (M, J) bool or None
        Which joints lean on an end stop; None if none does.
    poses : (M, P, 7) float64 or None
        Position (m) and quaternion xyzw of tracked frames in the world, NaN where they are not
        measured; None if none is tracked.
    pose_frames : tuple of str
        The P tracked frames.
    sensor_rates : tuple of float
        Rates at which the sensors of ``frames`` were measured, Hz; empty if all were at ``rate``.
    """

    stamp: IntArray
    rate: float
    position: FloatArray
    effort: FloatArray
    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    wrenches: FloatArray
    imu_frames: tuple[str, ...]
    wrench_frames: tuple[str, ...]
    touching: BoolArray | None = None
    stopped: BoolArray | None = None
    poses: FloatArray | None = None
    pose_frames: tuple[str, ...] = ()
    sensor_rates: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames of all sensors, IMUs first."""
        return (*self.imu_frames, *self.wrench_frames)

    @property
    def nbytes(self) -> int:
        """Size of the arrays, bytes."""
        return sum(
            value.nbytes
            for entry in fields(self)
            if isinstance(value := getattr(self, entry.name), np.ndarray)
        )

    def is_continued_by(self, later: "Segment") -> bool:
        """Tell whether another segment starts where this one ends."""
        step = int(later.stamp[0] - self.stamp[-1])
        return self.frames == later.frames and 0 < step * self.rate < 1.5e9

    def cut(self, start: int, stop: int) -> "Segment":
        """Return the instants from ``start`` up to ``stop``."""
        return map_arrays(self, lambda values: values[start:stop])


def cut_to(segments: Sequence[Segment], start: int, stop: int) -> Iterator[Segment]:
    """Yield the parts of segments from ``start`` up to ``stop``, ns."""
    for segment in segments:
        first, last = np.searchsorted(segment.stamp, [start, stop]).tolist()
        if last > first:
            yield segment.cut(first, last)


def shift_behind(start: int, end: int) -> int:
    """Return by how much stamps from ``start`` on move so that they come after ``end``, ns.

    They move by whole minutes, so that :func:`fingerprint` stays the same.
    """
    return MINUTE * -(-(end - start + SHORTEST_PAUSE) // MINUTE)


def fingerprint(segment: Segment) -> frozenset[int]:
    """Return an identifier of each whole second of a segment, so that none is counted twice.

    The identifier does not change when a log is cut, split or copied. It is the second itself for
    stamps of a wall clock, otherwise a hash of the joint states at the start of the second. That is
    the same after a move by whole minutes.
    """
    if len(segment) == 0:
        return frozenset()
    slack = int(1.5 * SECOND / segment.rate)
    first = -((slack - int(segment.stamp[0])) // SECOND)
    last = (int(segment.stamp[-1]) + slack) // SECOND
    if segment.stamp[0] >= WALL_CLOCK:
        return frozenset(range(first, last))
    begins = np.searchsorted(segment.stamp, SECOND * np.arange(first, last))
    return frozenset(_hash(segment, index) for index in begins.tolist())


def _hash(segment: Segment, index: int) -> int:
    stamp = segment.stamp[index] % MINUTE
    parts = stamp, segment.position[index], segment.effort[index]
    content = b"".join(np.asarray(part).tobytes() for part in parts)
    return int.from_bytes(blake2b(content, digest_size=8).digest(), signed=True)


class RemoteSegments(ABC):
    """The segments of a log on other machines; iterating over them transfers them.

    What needs less than the segments themselves asks for that.
    """

    @abstractmethod
    def __iter__(self) -> Iterator[Segment]: ...

    @abstractmethod
    def spans(self) -> list[tuple[int, int]]:
        """Return the first and the last stamp of each segment, ns."""

    @abstractmethod
    def between(self, start: int, stop: int) -> "RemoteSegments":
        """Return the segments from ``start`` up to ``stop``, ns."""

    @abstractmethod
    def apply(
        self, function: Callable[[Iterable[Segment]], list[NDArray[np.float64]]]
    ) -> list[FloatArray]:
        """Return the arrays that a function of a module computes from parts of the segments."""


@dataclass(frozen=True)
class _Part:
    """The segments from ``start`` up to ``stop``, ns, cut anew in every iteration."""

    segments: Iterable[Segment]
    start: int
    stop: int

    def __iter__(self) -> Iterator[Segment]:
        for segment in self.segments:
            yield from cut_to([segment], self.start, self.stop)


def stamp_spans(segments: Iterable[Segment]) -> list[tuple[int, int]]:
    """Return the first and the last stamp of each segment, ns."""
    if isinstance(segments, RemoteSegments):
        return segments.spans()
    return [(int(one.stamp[0]), int(one.stamp[-1])) for one in segments]


def split(
    segments: Iterable[Segment], gap: float, source: str
) -> tuple[Iterable[Segment], Iterable[Segment]]:
    """Return the segments before the last quarter of the covered time, and those in it.

    Parameters
    ----------
    segments : iterable of Segment
    gap : float
        Time between both that belongs to neither, s: the longest window, so that no averaged signal
        enters both.
    source : str
        Name of the log, for messages.

    Raises
    ------
    DataError
        When nothing is left of one part.
    """
    spans = stamp_spans(segments)
    lengths = np.array([stop - start for start, stop in spans])
    left = (1 - HELD_OUT) * float(lengths.sum())
    ends = np.cumsum(lengths)
    index = min(int(np.searchsorted(ends, left)), len(spans) - 1)
    border = spans[index][1] - int(ends[index] - left)
    begin = border + round(1e9 * gap)
    if border <= spans[0][0] or begin >= spans[-1][1]:
        raise DataError(f"{source}: too short to hold out a part; record longer", "E529")
    if isinstance(segments, RemoteSegments):
        return segments.between(spans[0][0], border), segments.between(begin, spans[-1][1] + 1)
    return (
        _Part(segments, spans[0][0], border),
        _Part(segments, begin, spans[-1][1] + 1),
    )
