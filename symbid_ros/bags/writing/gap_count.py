"""Gaps of a topic while it is recorded, in memory that does not grow."""

from array import array

import numpy as np

from symbid_ros.signals.gaps import Gaps, find_gaps

BLOCK = 65536  # stamps


class GapCount:
    """Judges the stamps of one topic block by block."""

    def __init__(self) -> None:
        self._stamps = array("q")
        self._blocks: list[Gaps] = []

    def add(self, stamp: int) -> None:
        """Count a message; its stamp in nanoseconds, in order of arrival."""
        self._stamps.append(stamp)
        if len(self._stamps) > BLOCK:
            self._blocks.append(find_gaps(np.array(self._stamps)))
            del self._stamps[:-1]  # the next block's first distance begins here

    @property
    def gaps(self) -> Gaps:
        """What the stamps tell so far; the period is the blocks' median."""
        blocks = [*self._blocks, find_gaps(np.array(self._stamps, dtype=np.int64))]
        periods = [block.period for block in blocks if block.period]
        return Gaps(
            period=int(np.median(periods)) if periods else 0,
            gaps=sum(block.gaps for block in blocks),
            missing=sum(block.missing for block in blocks),
            longest=max(block.longest for block in blocks),
            disordered=sum(block.disordered for block in blocks),
        )
