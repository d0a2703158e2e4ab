"""Segments of a log that is iterated several times: in memory, and beyond a limit in a file."""

import mmap
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import IO, Any

import numpy as np

from symbid_ros.signals.segments import Segment

ALIGNMENT = 64  # bytes


class SegmentStore:
    """Segments in the order in which they were added.

    The file has no name and is gone with the store.

    Parameters
    ----------
    most_kept : int
        Bytes to keep in memory.
    """

    def __init__(self, most_kept: int) -> None:
        self._free = most_kept
        self._segments: list[Segment | _Stored] = []
        self._file: IO[bytes] | None = None

    def add(self, segment: Segment) -> None:
        """Add a segment.

        Raises
        ------
        OSError
            When the folder for temporary files is full or cannot be written.
        """
        self._free -= segment.nbytes
        if self._free >= 0:
            self._segments.append(segment)
            return
        if self._file is None:
            # It is closed together with the store.
            self._file = tempfile.TemporaryFile(prefix="symbid_", buffering=0)  # noqa: SIM115
        self._segments.append(_Stored.write(segment, self._file))

    def __iter__(self) -> Iterator[Segment]:
        for one in self._segments:
            if isinstance(one, Segment):
                yield one
            else:
                assert self._file is not None  # it was created for the first stored segment
                yield one.read(self._file)


@dataclass(frozen=True)
class _Stored:
    """A segment without samples, and where in a file the arrays of its samples are."""

    empty: Segment
    count: int
    places: dict[str, int]
    end: int

    @classmethod
    def write(cls, segment: Segment, file: IO[bytes]) -> "_Stored":
        places = {}
        for entry in fields(segment):
            values = getattr(segment, entry.name)
            if isinstance(values, np.ndarray):
                end = file.seek(0, os.SEEK_END)
                places[entry.name] = file.seek(-end % ALIGNMENT, os.SEEK_CUR)
                left = np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
                while left:
                    left = left[file.write(left) :]
        # The copies of empty slices do not keep the arrays in memory.
        empty = segment.cut(0, 0)
        return cls(
            replace(empty, **{name: getattr(empty, name).copy() for name in places}),
            len(segment),
            places,
            file.tell(),
        )

    def read(self, file: IO[bytes]) -> Segment:
        # Mapping spares the copies, and reads no array that is not used.
        start = min(self.places.values()) // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        content = mmap.mmap(file.fileno(), self.end - start, access=mmap.ACCESS_COPY, offset=start)
        arrays: dict[str, Any] = {}
        for name, place in self.places.items():
            shape = self.count, *getattr(self.empty, name).shape[1:]
            dtype = getattr(self.empty, name).dtype
            arrays[name] = np.ndarray(shape, dtype, content, place - start)
        return replace(self.empty, **arrays)
