"""Wheels of a robot whose base counts as fixed: no sensor measures the forces of the ground."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.tree import Joint

ROLLED = np.pi  # rad; wheels of a parked base turn less


def rolling_wheels(position: FloatArray, joints: Sequence[Joint]) -> list[str]:
    """Return the joints (J) that are named wheels and have turned, at positions (N, J), rad."""
    if not len(position):
        return []
    travel = np.nanmax(position, axis=0, initial=-np.inf) - np.nanmin(
        position, axis=0, initial=np.inf
    )
    return [
        joint.name
        for joint, turned in zip(joints, travel.tolist(), strict=True)
        if "wheel" in joint.name.lower()
        and joint.kind == "revolute"
        and not (np.isfinite(joint.lower) or np.isfinite(joint.upper))
        and turned > ROLLED
    ]


def wheel_advice(names: Sequence[str]) -> str:
    """Return what to do about wheels that have rolled."""
    return (
        f"wheels seem to roll on the ground: {', '.join(names)}; their efforts contain its forces, "
        "which no sensor measures; give `wheel_topic`, which leaves out times of driving, or make "
        "these joints fixed in the model"
    )
