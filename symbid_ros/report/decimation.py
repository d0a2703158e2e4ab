"""Long series thinned for a figure without losing their peaks."""

import numpy as np

from symbid_ros.arrays import FloatArray


def thin(time: FloatArray, value: FloatArray, points: int) -> tuple[FloatArray, FloatArray]:
    """Keep the smallest and the largest sample of every stretch, in the order of time.

    Parameters
    ----------
    time, value : (N,) float64
        The series.
    points : int
        At most so many samples are kept, two of each stretch.

    Returns
    -------
    time, value : (M,) float64
        M is at most ``points``; the series itself when it is short enough.
    """
    samples = len(time)
    if samples <= points:
        return time, value
    stretches = points // 2
    length = -(-samples // stretches)
    # The last stretch repeats the last sample: no peak is invented by it.
    index = np.minimum(np.arange(stretches * length), samples - 1).reshape(stretches, length)
    block = value[index]
    rows = np.arange(stretches)
    extremes = np.stack([index[rows, block.argmin(axis=1)], index[rows, block.argmax(axis=1)]])
    kept = np.unique(extremes)
    return time[kept], value[kept]
