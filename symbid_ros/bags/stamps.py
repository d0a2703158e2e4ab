"""Header stamps in order: what is sorted, dropped and refused."""

import logging

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError

CLOCK_JUMP = 1_000_000_000  # ns; messages overtake each other by milliseconds, clocks jump further

logger = logging.getLogger("symbid_ros.bags")


def seconds(stamp: int | np.int64) -> str:
    """Return a stamp as the user sees it."""
    return f"{int(stamp) / 1e9:.3f} s"


def kept_in_order(source: str, topic: str, stamp: IntArray) -> IntArray:
    """Return the places of the messages to keep, by strictly increasing stamp.

    Messages that overtook each other are sorted, repeated stamps dropped behind
    the first; both are counted in a warning.

    Parameters
    ----------
    source, topic : str
        For messages to the user.
    stamp : (N,) int64
        Nanoseconds, in order of recording.

    Returns
    -------
    (K,) int64
    """
    step = np.diff(stamp)
    jumps = np.flatnonzero(step < -CLOCK_JUMP)
    if len(jumps):
        at = jumps[0]
        raise DataError(
            f"{source}: {topic}: header stamps jump back by {seconds(-step[at])} after "
            f"{seconds(stamp[at])}; give each run separately"
        )
    order: IntArray = np.argsort(stamp, kind="stable")
    repeated = np.concatenate([[False], np.diff(stamp[order]) == 0])
    if len(stamp) > 1 and repeated[1:].all():
        raise DataError(
            f"{source}: {topic}: all header stamps are {seconds(stamp[0])}; "
            "let the driver fill header.stamp"
        )
    unordered = int(np.count_nonzero(step < 0))
    dropped = int(np.count_nonzero(repeated))
    if unordered:
        logger.warning("%s: %s: %d messages out of order, sorted", source, topic, unordered)
    if dropped:
        logger.warning("%s: %s: %d messages repeat a stamp, dropped", source, topic, dropped)
    kept: IntArray = order[~repeated]
    return kept
