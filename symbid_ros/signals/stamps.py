"""Header stamps of one topic: their order, gaps and clock jumps."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.signals.defects import Defect, DefectCounts, DefectError

CLOCK_JUMP = 1_000_000_000  # ns; messages overtake one another by milliseconds only


def seconds(stamp: int | np.int64) -> str:
    """Return a stamp as text."""
    return f"{int(stamp) / 1e9:.3f} s"


def check_clock(source: str, topic: str, stamp: IntArray) -> None:
    """Check that stamps (N,), ns in order of recording, do not jump back.

    Raises
    ------
    DefectError
        When they do, by more than a second.
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
            "E314",
        )


def kept_in_order(stamp: IntArray, tally: DefectCounts) -> IntArray:
    """Return the indices (K,) of the messages to keep, by strictly increasing stamp.

    Messages out of order are sorted. Of messages with equal stamps the first is kept. Both are
    counted.

    Parameters
    ----------
    stamp : (N,) int64
        Nanoseconds, in order of recording.
    tally : DefectCounts
        Counts of the topic.
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
            "E315",
        )
    tally.add(Defect.DISORDER, stamp[1:], np.diff(stamp) < 0)
    tally.add(Defect.DUPLICATE, stamp[order], repeated)
    kept: IntArray = order[~repeated]
    return kept


@dataclass(frozen=True)
class Gaps:
    """Gaps of one topic.

    Attributes
    ----------
    period : int
        Median interval between stamps, ns; 0 for fewer than two messages.
    gaps, missing : int
        Intervals of at least 1.5 periods, and the number of messages that would fill them.
    longest : int
        Longest interval, ns.
    disordered : int
        Stamps that are not later than the previous one.
    """

    period: int
    gaps: int
    missing: int
    longest: int
    disordered: int


def find_gaps(stamps: IntArray) -> Gaps:
    """Find the gaps in stamps (N,), ns in order of arrival."""
    disordered = int(np.count_nonzero(np.diff(stamps) <= 0))
    step = np.diff(np.unique(stamps))
    if not len(step):
        return Gaps(0, 0, 0, 0, disordered)
    period = int(np.median(step))
    wide = step[2 * step >= 3 * period]
    missing = int(np.sum(np.rint(wide / period) - 1))
    return Gaps(period, len(wide), missing, int(step.max()), disordered)
