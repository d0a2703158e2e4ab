"""A recording cut into slices of time, which is how checks and identification read it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError
from symbid_ros.signals.defects import Tally
from symbid_ros.signals.streams import Streams


@dataclass(frozen=True)
class TimeRange:
    """A part of a recording, in seconds after its first joint state."""

    start: float = 0.0
    stop: float = np.inf

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise DataError(
                f"from {self.start:g} s to {self.stop:g} s is no part of a recording; give a start "
                "from 0 on and a later stop, seconds after the first joint state"
            )


@dataclass(frozen=True)
class Slice:
    """A slice of a recording.

    Attributes
    ----------
    start, stop : int
        From where up to where, ns of header.stamp.
    streams : Streams or None
        Of that time, and of a margin at both ends; None where a topic was silent.
    stamps : dict of str to (N,) int64
        By topic the stamps of that time as they were recorded, ns.
    tallies : tuple of Tally
        What was mended so far, one for each topic; they go on counting.
    fault : str
        Which was silent; empty where none was.
    """

    start: int
    stop: int
    streams: Streams | None
    stamps: Mapping[str, IntArray]
    tallies: tuple[Tally, ...]
    fault: str = ""


ALL_OF_IT = TimeRange()
