"""Times at which a wheeled base drives, which are left out: the base counts as fixed."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray

# A base slower than this, m/s and rad/s, is parked: wheel odometry at rest is exact.
PARKED_SPEED, PARKED_RATE = 0.005, 0.01
# Time before and after a motion, ns, in which the base still settles on its tyres.
SETTLING = 500_000_000


def is_driving(linear: FloatArray, angular: FloatArray) -> BoolArray:
    """Return whether a base drives at velocities (N, 3) and rates (N, 3)."""
    speed, rate = (np.linalg.norm(values, axis=1) for values in (linear, angular))
    # What is not known is not parked.
    driving: BoolArray = ~((speed < PARKED_SPEED) & (rate < PARKED_RATE))
    return driving


def driving_intervals(stamp: IntArray, driving: BoolArray) -> tuple[tuple[int, int], ...]:
    """Return first and last stamps, ns, of each motion of a base at stamps (N,).

    ``SETTLING`` before and after belongs to it.
    """
    edges = np.flatnonzero(np.diff(driving, prepend=False, append=False))
    return tuple(
        (int(stamp[start]) - SETTLING, int(stamp[stop - 1]) + SETTLING)
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    )
