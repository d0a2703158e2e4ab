"""Realigns channels of a log that are late, by interpolation."""

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray


def advanced(values: FloatArray, stamp: IntArray, delay: float) -> FloatArray:
    """Return what a late sensor reports ``delay`` later, so that its readings are in time.

    A cubic polynomial through four neighbours interpolates uniform samples (Lagrange), which are
    low-passed, so that it is exact for practical purposes. The first and last values are repeated.

    Parameters
    ----------
    values : (N, ...) float64
        NaN affects its neighbours only.
    stamp : (N,) int64
        Nanoseconds, nearly uniform.
    delay : float
        Seconds; negative if the sensor's stamps are late.
    """
    count = len(values)
    if delay == 0 or count < 2:
        return values
    time = 1e-9 * (stamp - stamp[0])
    place = np.interp(time + delay, time, np.arange(count))
    width = min(4, count)
    first = np.clip(np.floor(place).astype(np.int64) + 1 - width // 2, 0, count - width)
    place -= first
    weights = np.ones((count, width))
    for one in range(width):
        for other in range(width):
            if one != other:
                weights[:, one] *= (place - other) / (one - other)
    realigned: FloatArray = np.einsum(
        "nk,nk...->n...", weights, values[first[:, None] + np.arange(width)]
    )
    return realigned
