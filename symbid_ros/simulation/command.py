"""External torque commands: their validation, and safe torques when no command arrives."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from symbid_ros.arrays import FloatArray

# Slows down a falling robot. At 1 kHz with one period of delay, the lightest joint (an ankle) stays
# far from instability.
SAFE_DAMPING = 2.0  # Nm s/rad


class Rejection(StrEnum):
    """Reason why a command was rejected."""

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
    """Drive torques for one period.

    Attributes
    ----------
    torques : (n_actuated,) float64
        Nm.
    is_safe : bool
        Whether these are the safe torques because no command arrived.
    """

    torques: FloatArray
    is_safe: bool


@dataclass
class CommandCounts:
    """Counts of received datagrams, retries and timeouts.

    Attributes
    ----------
    accepted : int
        Commands executed.
    hellos : int
        Datagrams that requested measurements.
    resent : int
        Measurements sent again because no command arrived.
    timeouts : int
        Number of times a controller stopped responding.
    rejected : dict of str to int
        Rejected datagrams by reason.
    """

    accepted: int = 0
    hellos: int = 0
    resent: int = 0
    timeouts: int = 0
    rejected: dict[Rejection, int] = field(default_factory=lambda: dict.fromkeys(Rejection, 0))


class Drives:
    """Torque limits of the drives, and safe torques.

    Safe torques damp each driven joint and are otherwise zero.

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
        """Return damping torques (n_actuated,), Nm, for measured joint velocities (J,), rad/s."""
        damping = -SAFE_DAMPING * joint_velocity[self._joints]
        return np.clip(damping, self._lowest, self._highest)

    def validate(self, torques: FloatArray) -> Rejection | None:
        """Return the reason to reject torques (n_actuated,), Nm, or None if they are valid."""
        if not np.all(np.isfinite(torques)):
            return Rejection.NOT_FINITE
        if np.any(torques < self._lowest) or np.any(torques > self._highest):
            return Rejection.BEYOND_LIMIT
        return None
