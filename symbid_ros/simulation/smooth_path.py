"""Paths with continuous acceleration: minimum-jerk moves and the linear inverted pendulum."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly, CubicSpline, PPoly
from scipy.linalg import solve_banded

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller import Reference

# Midway, a minimum-jerk move has 15/8 of its mean velocity and no acceleration.
MIDWAY_SPEED = 1.875
INTERVAL = 0.01  # s, between the samples of the pendulum


class PolynomialPath:
    """A piecewise polynomial over time, at rest before and after it.

    Parameters
    ----------
    polynomial : scipy.interpolate.PPoly
        Points (D,); its breakpoints start at 0 s.
    """

    def __init__(self, polynomial: PPoly) -> None:
        self._times = polynomial.x.tolist()
        # (pieces, terms, D), lowest power first.
        self._pieces = np.moveaxis(polynomial.c[::-1], 1, 0).copy()
        terms = np.arange(self._pieces.shape[1], dtype=np.float64)
        rates = terms * (terms - 1.0)
        self._factors = np.stack([np.ones_like(terms), terms, rates])
        # Powers of the time since the breakpoint: n, n - 1 and n - 2 for term n.
        self._powers = np.maximum(terms - np.arange(3.0)[:, None], 0.0)
        self.duration = float(self._times[-1])

    def at(self, time: float) -> FloatArray:
        """Return position, velocity and acceleration at ``time`` (s) as the rows of a (3, D)."""
        clipped = min(max(time, 0.0), self.duration)
        piece = min(bisect_right(self._times, clipped), len(self._pieces)) - 1
        shape = self._factors * (clipped - self._times[piece]) ** self._powers
        rows: FloatArray = np.dot(shape, self._pieces[piece])
        if not 0.0 <= time <= self.duration:
            rows[1:] = 0.0
        return rows


class MinimumJerkPath:
    """Builds a path through points: quintic moves from rest to rest, unless told otherwise.

    With zero acceleration at both ends, a quintic minimises the integral of the squared jerk
    (Flash & Hogan 1985).

    Parameters
    ----------
    start : (D,) float64
        Point at time 0.

    Attributes
    ----------
    duration : float
        Time of the last point, s.
    """

    def __init__(self, start: FloatArray) -> None:
        rest = np.zeros_like(start)
        self._times, self._points = [0.0], [np.stack([start, rest, rest])]
        self.duration = 0.0

    @property
    def end(self) -> FloatArray:
        """(D,) last point."""
        return np.asarray(self._points[-1][0])

    def rest_until(self, time: float) -> None:
        """Stay at the last point until ``time`` (s), if that is later."""
        if time > self.duration:
            self.move_to(self.end, time - self.duration)

    def move_to(
        self, point: FloatArray, duration: float, velocity: FloatArray | None = None
    ) -> None:
        """Move to a point (D,) in ``duration`` seconds and arrive with a velocity (D,)."""
        rest = np.zeros_like(self.end)
        self.duration += duration
        self._times.append(self.duration)
        self._points.append(np.stack([point, rest if velocity is None else velocity, rest]))

    def path(self) -> PolynomialPath:
        """Return the path through the points so far."""
        quintics = BPoly.from_derivatives(self._times, np.stack(self._points))
        return PolynomialPath(PPoly.from_bernstein_basis(quintics))


def pendulum_path(pressure: PolynomialPath, height: float, gravity: float) -> PolynomialPath:
    """Return the motion of a pendulum's mass whose centre of pressure follows a path.

    The linear inverted pendulum ``y - height / gravity * d²y/dt² = p`` has one solution that is
    above p at both ends (Kajita et al. 2003). Central differences find it.

    Parameters
    ----------
    pressure : PolynomialPath
        Centre of pressure p (D,), m. It rests at both ends for two seconds or more.
    height : float
        Of the pendulum, m.
    gravity : float
        m/s².
    """
    times = np.linspace(0.0, pressure.duration, round(pressure.duration / INTERVAL) + 1)
    points = np.stack([pressure.at(time)[0] for time in times.tolist()])
    stiffness = height / gravity / (times[1] - times[0]) ** 2
    bands = np.zeros((3, len(times)))
    bands[0, 2:] = bands[2, :-2] = -stiffness
    bands[1] = 1.0 + 2.0 * stiffness
    bands[1, [0, -1]] = 1.0
    mass = solve_banded((1, 1), bands, points)
    return PolynomialPath(CubicSpline(times, mass))


@dataclass(frozen=True)
class CombinedPath:
    """Paths side by side: their columns follow each other."""

    paths: tuple[Reference, ...]

    @property
    def duration(self) -> float:
        """Of the longest, s."""
        return max(path.duration for path in self.paths)

    def at(self, time: float) -> FloatArray:
        """Return position, velocity and acceleration at ``time`` (s) as the rows of a (3, D)."""
        return np.hstack([path.at(time) for path in self.paths])
