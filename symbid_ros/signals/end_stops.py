"""Where joints lean on the ends of their ranges, whose forces no sensor measures."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.friction import by_kind
from symbid_ros.model.tree import Joint

# Distance from an end, of revolute and prismatic joints, rad and m, from which on a stop may push:
# stops are soft, and zeros of encoders and limits of files are rounded.
NEAR = 0.02, 0.002


def end_stop_depth(position: FloatArray, joints: Sequence[Joint]) -> FloatArray:
    """Return how far positions (N, J) are beyond the points at which end stops may push, rad or m.

    It is positive at the upper end, negative at the lower end, and zero between.
    """
    lower, upper = (np.array([getattr(one, end) for one in joints]) for end in ("lower", "upper"))
    near = by_kind(NEAR, joints)
    depth: FloatArray = np.maximum(position - (upper - near), 0.0)
    depth += np.minimum(position - (lower + near), 0.0)
    return depth


def at_end_stops(position: FloatArray, joints: Sequence[Joint]) -> BoolArray:
    """Return where joints (N, J) with end stops lean on one of them."""
    has_stops = np.array([joint.has_stops for joint in joints])
    found: BoolArray = (end_stop_depth(position, joints) != 0) & has_stops
    return found
