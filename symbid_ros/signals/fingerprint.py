"""Which seconds of which motion a record covers, so that none is counted twice."""

from hashlib import blake2b

import numpy as np

from symbid_ros.signals.alignment import Segment

SECOND = 1_000_000_000  # ns
# Stamps from here on, in September 2001, are those of a wall clock, which shows each second once.
# Simulated time, and the clock of a computer that has not been set, begin at 0 in every run.
WALL_CLOCK = SECOND * SECOND


def fingerprint(segment: Segment) -> frozenset[int]:
    """Return a number for each whole second of a segment.

    Equal seconds of one log have equal numbers however the log was cut, split or copied: the
    second itself by a wall clock, else a hash of the joint states at its beginning.
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
    parts = segment.stamp[index], segment.position[index], segment.effort[index]
    content = b"".join(np.asarray(part).tobytes() for part in parts)
    return int.from_bytes(blake2b(content, digest_size=8).digest(), signed=True)
