"""Times at which a wheeled base drives, which are left out: the base counts as fixed."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray

# A base slower than this, m/s and rad/s, is parked: wheel odometry at rest is exact.
PARKED_SPEED, PARKED_RATE = 0.005, 0.01
# Time before and after a motion, ns, in which the base still settles on its tyres.
SETTLING = 500_000_000
# Length of a moving average, s, applied twice. It contains neither noise nor vibration.
AVERAGE = 0.25
# A parked base turns slower than this, rad/s, offset of the gyroscope included.
LARGEST_RATE = 0.03
# By how much the specific force of a parked base varies, m/s², within so many seconds: 1 % of
# gravity, which changes torques by as much.
LARGEST_CHANGE, CHANGE_TIME = 0.1, 1.0


def is_driving(linear: FloatArray, angular: FloatArray) -> BoolArray:
    """Return whether a base drives at velocities (N, 3) and rates (N, 3)."""
    speed, rate = (np.linalg.norm(values, axis=1) for values in (linear, angular))
    # What is not known is not parked.
    driving: BoolArray = ~((speed < PARKED_SPEED) & (rate < PARKED_RATE))
    return driving


def is_accelerating(stamp: IntArray, rate: FloatArray, force: FloatArray) -> BoolArray:
    """Return whether a base accelerates or turns according to an IMU on it.

    Only these motions change the equation of motion: a base at constant velocity counts as parked.
    The offsets of the sensor cancel or are below the limit (moving variance and angular rate, the
    detectors of Skog et al. 2010, IEEE Trans. Biomed. Eng. 57(11)).

    Parameters
    ----------
    stamp : (N,) int64
        Increasing, ns.
    rate : (N, 3) float64
        Angular velocity, rad/s.
    force : (N, 3) float64
        Specific force, m/s².
    """
    # Its import takes as long as that of the rest, and few robots need it.
    from scipy.ndimage import (  # noqa: PLC0415
        maximum_filter1d,
        minimum_filter1d,
        uniform_filter1d,
    )

    if len(stamp) < 2:
        return np.ones(len(stamp), dtype=bool)
    period = 1e-9 * float(np.median(np.diff(stamp)))
    average, span = (max(round(time / period), 1) for time in (AVERAGE, CHANGE_TIME))

    def smooth(values: FloatArray) -> FloatArray:
        once = uniform_filter1d(values, average, axis=0)
        twice: FloatArray = uniform_filter1d(once, average, axis=0)
        return twice

    turning, mean = smooth(rate), smooth(force)
    change = maximum_filter1d(mean, span, axis=0) - minimum_filter1d(mean, span, axis=0)
    turn, shift = (np.linalg.norm(each, axis=1) for each in (turning, change))
    found: BoolArray = (turn > LARGEST_RATE) | (shift > LARGEST_CHANGE)
    return found


def driving_intervals(stamp: IntArray, driving: BoolArray) -> tuple[tuple[int, int], ...]:
    """Return first and last stamps, ns, of each motion of a base at stamps (N,).

    ``SETTLING`` before and after belongs to it.
    """
    edges = np.flatnonzero(np.diff(driving, prepend=False, append=False))
    return tuple(
        (int(stamp[start]) - SETTLING, int(stamp[stop - 1]) + SETTLING)
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    )
