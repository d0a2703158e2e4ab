"""What header stamps tell of lost messages."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import IntArray


@dataclass(frozen=True)
class Gaps:
    """How complete a topic is.

    Attributes
    ----------
    period : int
        Median distance of successive stamps, nanoseconds; 0 below two messages.
    gaps, missing : int
        Distances of 1.5 periods and more, and the messages that would fill them.
    longest : int
        Largest distance, nanoseconds.
    disordered : int
        Stamps not later than the one before.
    """

    period: int
    gaps: int
    missing: int
    longest: int
    disordered: int


def find_gaps(stamps: IntArray) -> Gaps:
    """Judge the stamps (N,) of one topic, nanoseconds in order of arrival."""
    disordered = int(np.count_nonzero(np.diff(stamps) <= 0))
    step = np.diff(np.unique(stamps))
    if not len(step):
        return Gaps(0, 0, 0, 0, disordered)
    period = int(np.median(step))
    wide = step[2 * step >= 3 * period]
    missing = int(np.sum(np.rint(wide / period) - 1))
    return Gaps(period, len(wide), missing, int(step.max()), disordered)
