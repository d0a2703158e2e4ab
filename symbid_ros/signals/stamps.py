"""Header stamps in order: what is sorted, dropped and refused."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.signals.defects import Defect, DefectCounts, DefectError

CLOCK_JUMP = 1_000_000_000  # ns; messages overtake each other by milliseconds, clocks jump further


def seconds(stamp: int | np.int64) -> str:
    """Return a stamp as the user sees it."""
    return f"{int(stamp) / 1e9:.3f} s"


def check_clock(source: str, topic: str, stamp: IntArray) -> None:
    """Refuse stamps (N,), ns in order of recording, that jump back to another time.

    Raises
    ------
    DefectError
        Where they do.
    """
    step = np.diff(stamp)
    jumps = np.flatnonzero(step < -CLOCK_JUMP)
    if len(jumps):
        at = jumps[0]
        raise DefectError(
            topic,
            Defect.CLOCK_JUMP,
            f"{source}: {topic}: header stamps jump back by {seconds(-step[at])} after "
            f"{seconds(stamp[at])}; give each run separately",
        )


def kept_in_order(stamp: IntArray, tally: DefectCounts) -> IntArray:
    """Return the places of the messages to keep, by strictly increasing stamp.

    Messages that overtook each other are sorted, repeated stamps dropped behind
    the first; both are counted.

    Parameters
    ----------
    stamp : (N,) int64
        Nanoseconds, in order of recording.
    tally : DefectCounts
        Of their topic.

    Returns
    -------
    (K,) int64
    """
    check_clock(tally.source, tally.topic, stamp)
    order: IntArray = np.argsort(stamp, kind="stable")
    repeated = np.concatenate([[False], np.diff(stamp[order]) == 0])
    if len(stamp) > 1 and repeated[1:].all():
        raise DefectError(
            tally.topic,
            Defect.DUPLICATE,
            f"{tally.source}: {tally.topic}: all header stamps are {seconds(stamp[0])}; "
            "let the driver fill header.stamp",
        )
    tally.add(Defect.DISORDER, stamp[1:], np.diff(stamp) < 0)
    tally.add(Defect.DUPLICATE, stamp[order], repeated)
    kept: IntArray = order[~repeated]
    return kept


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
