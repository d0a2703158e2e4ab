"""Reference trajectories: straight moves from point to point, cubic in time."""

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError


@dataclass(frozen=True)
class Trajectory:
    """A sequence of straight moves with a pause before the first and after the last.

    Each move follows ``p(u) = a + (3u² - 2u³)(b - a)`` with u from 0 to 1, at rest at both ends
    (thesis, section IV-A). The points may be positions, rotation vectors or joint angles.

    Attributes
    ----------
    points : (n + 1, D) float64
        Start and the n targets.
    starts : tuple of n + 1 floats
        Start time of each move, then the end of the last one, s.
    duration : float
        End of the last pause, s.
    """

    points: FloatArray
    starts: tuple[float, ...]
    duration: float

    def at(self, time: float) -> FloatArray:
        """Return position, velocity and acceleration at ``time`` (s) as the rows of a (3, D)."""
        starts = self.starts
        move = min(max(bisect_right(starts, time) - 1, 0), len(starts) - 2)
        span = starts[move + 1] - starts[move]
        u = (time - starts[move]) / span
        if not 0.0 <= u < 1.0:
            u, span = min(max(u, 0.0), 1.0), math.inf
        blend = u * u * (3.0 - 2.0 * u)
        speed, change = 6.0 * u * (1.0 - u) / span, 6.0 * (1.0 - 2.0 * u) / (span * span)
        shape = np.array([1.0 - blend, blend, -speed, speed, -change, change]).reshape(3, 2)
        rows: FloatArray = np.dot(shape, self.points[move : move + 2])
        return rows


@dataclass(frozen=True)
class MoveRange:
    """Range of the targets and of the speeds of random moves.

    Attributes
    ----------
    centre : (D,) float64
        Centre of the ellipsoid near whose surface the targets lie, relative to the start.
    half_widths : (D,) float64
        Its half axes.
    speeds : tuple of 2 floats
        Mean speed of the first and last move, and of the move in the middle, per second.
    shortest : float
        Minimum length of a move. The acceleration is at most ``6 speeds[1]² / shortest``. Must be
        smaller than the largest half width, or there may be no next target.
    rest : float
        Pause before the first and after the last move, s.
    """

    centre: FloatArray
    half_widths: FloatArray
    speeds: tuple[float, float]
    shortest: float
    rest: float = 0.5


def draw_trajectory(
    start: FloatArray, moves: int, span: MoveRange, random: np.random.Generator
) -> Trajectory:
    """Draw random moves whose speed increases up to the middle and then decreases.

    Parameters
    ----------
    start : (D,) float64
        First point.
    moves : int
        Number of moves, at least 1.
    span : MoveRange
        Targets and speeds.
    random : numpy.random.Generator
        Source of the targets; the same state gives the same trajectory.
    """
    if moves < 1:
        raise SimulationError(f"{moves} moves; set moves to 1 or more", "E605")
    points = [np.zeros_like(start)]
    while len(points) <= moves:
        direction = random.standard_normal(start.size)
        radius = random.uniform(0.75, 1.0)
        target = span.centre + span.half_widths * direction * (radius / np.linalg.norm(direction))
        if np.linalg.norm(target - points[-1]) >= span.shortest:
            points.append(target)
    offsets = np.array(points)
    rise = np.sin(np.pi * np.arange(moves) / max(moves - 1, 1))
    slowest, fastest = span.speeds
    speeds = slowest + (fastest - slowest) * rise
    times = np.linalg.norm(np.diff(offsets, axis=0), axis=1) / speeds
    starts = span.rest + np.concatenate([[0.0], np.cumsum(times)])
    return Trajectory(start + offsets, tuple(starts.tolist()), float(starts[-1] + span.rest))
