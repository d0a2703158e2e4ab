"""Segments of a log that is iterated several times: in memory, and beyond a limit in a file."""

import logging
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from typing import IO, Any

import numpy as np

from symbid_ros.signals.segments import Segment

logger = logging.getLogger(__name__)

ALIGNMENT = 64  # bytes


class SegmentStore:
    """Segments in the order in which they were added.

    The file has no name and is gone with the store.

    Parameters
    ----------
    most_kept : int
        Bytes to keep in memory.

    Attributes
    ----------
    is_complete : bool
        Whether all segments could be kept.
    """

    def __init__(self, most_kept: int) -> None:
        self.is_complete = True
        self._free = most_kept
        self._segments: list[Segment | Stored] = []
        self._file: IO[bytes] | None = None

    def keep(self, segments: Iterable[Segment]) -> Iterator[Segment]:
        """Yield segments and add them."""
        for segment in segments:
            self._free -= segment.nbytes
            self._append(segment if self._free >= 0 else self.write(segment))
            yield segment

    def write(self, segment: Segment) -> "Stored | None":
        """Write a segment to the file; None if the folder for temporary files is full or locked."""
        if not self.is_complete:
            return None
        try:
            return Stored.write(segment, self.open_file())
        except OSError as error:
            logger.info("%s: the log is read again for each step", error)
            self.is_complete = False
            return None

    def receive(self, one: "Segment | Stored") -> Segment:
        """Add a segment that a copy of this process has written, if it could, and return it."""
        if isinstance(one, Segment):
            self._append(None)
            return one
        self._append(one)
        return one.read(self.open_file())

    def open_file(self) -> IO[bytes]:
        """Return the file, which is created when it is first needed and closed with the store.

        Raises
        ------
        OSError
            When there is no folder for temporary files.
        """
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="symbid_", buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        return self._file

    def _append(self, one: "Segment | Stored | None") -> None:
        self.is_complete = self.is_complete and one is not None
        if one is not None and self.is_complete:
            self._segments.append(one)
        else:
            self._segments.clear()

    def __iter__(self) -> Iterator[Segment]:
        for one in self._segments:
            yield one if isinstance(one, Segment) else one.read(self.open_file())


@dataclass(frozen=True)
class Stored:
    """A segment without samples, and where in a file the arrays of its samples are."""

    empty: Segment
    count: int
    places: dict[str, int]
    end: int

    @classmethod
    def write(cls, segment: Segment, file: IO[bytes]) -> "Stored":
        """Write a segment to the end of a file.

        Raises
        ------
        OSError
            When that fails.
        """
        places = {}
        for entry in fields(segment):
            values = getattr(segment, entry.name)
            if isinstance(values, np.ndarray):
                end = file.seek(0, os.SEEK_END)
                places[entry.name] = file.seek(-end % ALIGNMENT, os.SEEK_CUR)
                left = np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
                while left:
                    left = left[file.write(left) :]
        file.truncate()  # the last array may be without values, behind the end of what is written
        # The copies of empty slices do not keep the arrays in memory.
        empty = segment.cut(0, 0)
        return cls(
            replace(empty, **{name: getattr(empty, name).copy() for name in places}),
            len(segment),
            places,
            file.tell(),
        )

    def read(self, file: IO[bytes]) -> Segment:
        """Return the segment, whose arrays are mapped from the file."""
        # Mapping spares the copies, and reads no array that is not used.
        start = min(self.places.values()) // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        content = mmap.mmap(file.fileno(), self.end - start, access=mmap.ACCESS_COPY, offset=start)
        arrays: dict[str, Any] = {}
        for name, place in self.places.items():
            shape = self.count, *getattr(self.empty, name).shape[1:]
            dtype = getattr(self.empty, name).dtype
            arrays[name] = np.ndarray(shape, dtype, content, place - start)
        return replace(self.empty, **arrays)
