"""What is above, in the axes of a moving base."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.samples import Samples

# s without a sample, across which angular velocity is not integrated.
LONGEST_GAP = 0.5


def upward(samples: Samples) -> FloatArray:
    """Return the direction away from the earth (N, 3) in base axes, of consecutive samples.

    The gyroscope tells how the base turns from sample to sample. In axes that do not turn, the mean
    specific force points upwards, but for the mean acceleration, which is small: over 4 s a change
    of velocity of .2 m/s turns it by .3 degrees.
    """
    if samples.upward is not None:
        return samples.upward
    step = np.diff(samples.stamp) * 1e-9
    cuts = np.flatnonzero((step > LONGEST_GAP) | (step < 0)) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    result = np.empty((len(samples), 3))
    for start, stop in pairwise(edges):
        part = slice(start, stop)
        turned = _orientations(samples.base_angular_velocity[part], step[start : stop - 1])
        force = np.nan_to_num(samples.base_specific_force[part])
        mean = np.einsum("tij,tj->i", turned, force)
        size = float(np.linalg.norm(mean))
        above = mean / size if size > 0 else np.array([0.0, 0.0, 1.0])
        result[part] = np.einsum("tij,i->tj", turned, above)
    return result


def _orientations(rate: FloatArray, step: FloatArray) -> FloatArray:
    """Return the orientations (N, 3, 3) relative to the first, for rates (N, 3) in own axes."""
    turns = 0.5 * np.nan_to_num(rate[1:] + rate[:-1]) * step[:, None]
    turned = np.broadcast_to(np.eye(3), (len(rate), 3, 3)).copy()
    turned[1:] = Rotation.from_rotvec(turns).as_matrix()
    # Products of two, four, eight and so on steps give all of them without a loop over samples.
    reach = 1
    while reach < len(rate):
        turned[reach:] = turned[:-reach] @ turned[reach:]
        reach *= 2
    return turned
