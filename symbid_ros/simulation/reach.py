"""How far the moves of a standing robot go, which widens and narrows without a jump."""

from collections.abc import Callable

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller import BalanceGains, Reference

# Duration of a change, s. Widening 8 cm by all of it adds at most 5 cm/s, less than a fast move.
CHANGE_DURATION = 3.0
# Distance that planned centres of pressure keep from the soles' edges, m: an error of this size
# does not tip a sole.
MARGIN = BalanceGains().sole_margin
# Largest distance of a move's end from the middle and of the robot from there by an error, m.
LARGEST_DISTANCE = 0.1
GRAVITY = 9.81  # m/s²


def least_reach(size: float) -> float:
    """Return the share of their size that moves may have with any model.

    Parameters
    ----------
    size : float
        Largest distance of a move's end from the middle, m.
    """
    return min(1.0, MARGIN / size)


def safe_reach(mass_std: float, com_std: float, size: float) -> float:
    """Return the share of their size that moves may have with a model of limited accuracy.

    A wrong centre of mass displaces the robot as far as it is wrong. A mass that is wrong by a
    share e displaces it by e times gravity over the controller's stiffness. The size of a move and
    two standard deviations of this displacement must fit into :data:`LARGEST_DISTANCE`. The least
    reach uses up the margin of the soles alone.

    Parameters
    ----------
    mass_std : float
        Standard deviation of the robot's mass, as a share of it.
    com_std : float
        Standard deviation of its centre of mass, m.
    size : float
        Largest distance of a move's end from the middle, m.
    """
    displacement = float(np.hypot(com_std, mass_std * GRAVITY / BalanceGains().com_stiffness))
    share, least = (LARGEST_DISTANCE - 2.0 * displacement) / size, least_reach(size)
    # Written so that NaN gives the least reach.
    return min(share, 1.0) if share > least else least


class Reach:
    """A share of the size of all moves, whose changes have minimum jerk.

    Parameters
    ----------
    share : float
        At first, from 0 to 1.
    """

    def __init__(self, share: float = 1.0) -> None:
        self._from = self._to = self._wanted = share
        self._since = -np.inf

    @property
    def wanted(self) -> float:
        """The share that was last asked for."""
        return self._wanted

    def change(self, share: float, time: float) -> None:
        """Ask for another share from ``time`` (s) on; a change under way is finished first."""
        self._wanted = share
        self._begin(time)

    def _begin(self, time: float) -> None:
        if self._wanted != self._to and time >= self._since + CHANGE_DURATION:
            self._from, self._to, self._since = self._to, self._wanted, time

    def restart(self) -> None:
        """Finish all changes at once, because time restarts."""
        self._from = self._to = self._wanted
        self._since = -np.inf

    def at(self, time: float) -> tuple[float, float, float]:
        """Return the share, its rate (1/s) and its acceleration (1/s²) at ``time`` (s).

        Times must not decrease, except after `restart`.
        """
        self._begin(time)
        u = (time - self._since) / CHANGE_DURATION
        if u >= 1.0:
            return self._to, 0.0, 0.0
        u = max(u, 0.0)
        rise = self._to - self._from
        return (
            self._from + rise * u**3 * (10.0 - 15.0 * u + 6.0 * u * u),
            rise / CHANGE_DURATION * 30.0 * u * u * (1.0 - u) ** 2,
            rise / CHANGE_DURATION**2 * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u),
        )


class ScaledMotion:
    """A reference motion whose distance from its start is scaled, and which starts elsewhere.

    Parameters
    ----------
    motion : Reference
    offset : (D,) float64
        Added to all points.
    scale : callable
        Share of the distance from the start, its rate and its acceleration at a time (s).
    """

    def __init__(
        self,
        motion: Reference,
        offset: FloatArray,
        scale: Callable[[float], tuple[float, float, float]],
    ) -> None:
        self._motion, self._scale = motion, scale
        self._start = motion.at(0.0)[0]
        self._origin = self._start + offset
        self.duration = motion.duration

    def displacement(self, time: float) -> FloatArray:
        """Return the distance (D,) from the start at ``time`` (s)."""
        return np.asarray(self.at(time)[0] - self._origin)

    def at(self, time: float) -> FloatArray:
        """Return position, velocity and acceleration at ``time`` (s) as the rows of a (3, D)."""
        rows = np.array(self._motion.at(time))
        rows[0] -= self._start
        share, rate, change = self._scale(time)
        if rate or change:
            position, velocity = rows[0].copy(), rows[1].copy()
            rows *= share
            rows[1] += rate * position
            rows[2] += 2.0 * rate * velocity + change * position
        elif share != 1.0:
            rows *= share
        rows[0] += self._origin
        return rows
