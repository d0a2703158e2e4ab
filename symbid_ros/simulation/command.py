"""What drives are told from outside: torques, checked, and what they do without."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from symbid_ros.arrays import FloatArray

# Nm s/rad: a falling robot is slowed down like a person going limp, and at 1 kHz, a period late,
# this is far from making the lightest joint, an ankle, oscillate.
SAFE_DAMPING = 2.0


class Rejection(StrEnum):
    """Why a command was not obeyed."""

    LENGTH = "length"
    MAGIC = "magic"
    VERSION = "version"
    KIND = "kind"
    STRANGER = "stranger"
    DUPLICATE = "duplicate"
    OLD = "old"
    FUTURE = "future"
    STAMP = "stamp"
    NOT_FINITE = "not_finite"
    BEYOND_LIMIT = "beyond_limit"


@dataclass(frozen=True, slots=True)
class Command:
    """Torques for one period.

    Attributes
    ----------
    torques : (n_actuated,) float64
        Of the drives, Nm.
    is_safe : bool
        Whether they are the safe ones, for want of a command.
    """

    torques: FloatArray
    is_safe: bool


@dataclass
class CommandCounts:
    """What has come in so far.

    Attributes
    ----------
    accepted : int
        Commands obeyed.
    hellos : int
        Datagrams that asked for measurements.
    resent : int
        Measurements sent once more, as no answer had come.
    timeouts : int
        How often a controller fell silent.
    rejected : dict of str to int
        Datagrams by the reason why they were not obeyed.
    """

    accepted: int = 0
    hellos: int = 0
    resent: int = 0
    timeouts: int = 0
    rejected: dict[Rejection, int] = field(default_factory=lambda: dict.fromkeys(Rejection, 0))


class Drives:
    """Limits of the drives, and the torques that are safe whatever the robot does.

    Safe are torques that only ever brake: each drive's joint is damped, at zero torque otherwise.

    Parameters
    ----------
    joint_names, drive_names : sequence of str
        All joints, and the joint of each drive.
    limits : (n_actuated, 2) float64
        Lowest and highest torque of each drive, Nm.
    """

    def __init__(
        self, joint_names: Sequence[str], drive_names: Sequence[str], limits: FloatArray
    ) -> None:
        self._joints = np.array([joint_names.index(name) for name in drive_names], dtype=np.int64)
        self._lowest, self._highest = limits.T

    def __len__(self) -> int:
        """Return the number of drives."""
        return len(self._joints)

    def safe_torques(self, joint_velocity: FloatArray) -> FloatArray:
        """Return torques (n_actuated,), Nm, that brake joints of measured rates (J,), rad/s."""
        braking = -SAFE_DAMPING * joint_velocity[self._joints]
        return np.clip(braking, self._lowest, self._highest)

    def validate(self, torques: FloatArray) -> Rejection | None:
        """Return why torques (n_actuated,), Nm, are not to be applied, if there is a reason."""
        if not np.all(np.isfinite(torques)):
            return Rejection.NOT_FINITE
        if np.any(torques < self._lowest) or np.any(torques > self._highest):
            return Rejection.BEYOND_LIMIT
        return None
