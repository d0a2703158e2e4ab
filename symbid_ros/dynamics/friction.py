"""Coulomb friction, and where a joint slips fast enough to show it."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray

# Below this speed, rad/s or m/s, a joint may stick, and then its friction is whatever holds it.
COULOMB_SPEED = 0.02


def slips(velocity: FloatArray) -> BoolArray:
    """Return whether joints (N, J) move at ``COULOMB_SPEED`` or faster.

    A joint that sticks feels anything between the bounds ± its Coulomb friction, which no
    parameter of the equation of motion says: its row holds only where this is true.
    """
    moves: BoolArray = np.abs(velocity) >= COULOMB_SPEED
    return moves


def coulomb_column(velocity: FloatArray) -> FloatArray:
    """Return sign(q̇) (N, J) of Eq. 2.49, with a linear ramp below ``COULOMB_SPEED``.

    The ramp keeps noise about zero speed from switching a whole Coulomb friction on and off;
    it is no model of stiction.
    """
    column: FloatArray = np.clip(velocity / COULOMB_SPEED, -1.0, 1.0)
    return column
