"""Straight moves from point to point, cubic in time: what the robot is asked to do."""

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError


@dataclass(frozen=True)
class Trajectory:
    """A chain of straight moves with a rest before the first and after the last.

    Each move goes ``p(u) = a + (3u² - 2u³)(b - a)`` with u from 0 to 1, at rest at both ends
    (thesis, section IV-A). The points may be positions, rotation vectors or joint angles.

    Attributes
    ----------
    points : (n + 1, D) float64
        Start and the n targets.
    starts : tuple of n + 1 floats
        Time at which each move starts, s, and at which the last one ends.
    duration : float
        End of the last rest, s.
    """

    points: FloatArray
    starts: tuple[float, ...]
    duration: float

    def at(self, time: float) -> FloatArray:
        """Position, velocity and acceleration at ``time`` (s), one a row, (3, D)."""
        starts = self.starts
        move = min(max(bisect_right(starts, time) - 1, 0), len(starts) - 2)
        span = starts[move + 1] - starts[move]
        u = (time - starts[move]) / span
        if not 0.0 <= u < 1.0:
            u, span = min(max(u, 0.0), 1.0), math.inf
        gone = u * u * (3.0 - 2.0 * u)
        speed, change = 6.0 * u * (1.0 - u) / span, 6.0 * (1.0 - 2.0 * u) / (span * span)
        shape = np.array([1.0 - gone, gone, -speed, speed, -change, change]).reshape(3, 2)
        rows: FloatArray = np.dot(shape, self.points[move : move + 2])
        return rows


@dataclass(frozen=True)
class MoveRange:
    """Where targets may lie and how fast they are reached.

    Attributes
    ----------
    centre : (D,) float64
        Centre of the ellipsoid near whose surface the targets lie, from the start.
    half_widths : (D,) float64
        Its half axes.
    slowest, fastest : float
        Mean speed of the first and last move, and of the one amid the set, per second.
    shortest : float
        No move is shorter; with ``fastest`` this bounds the acceleration by
        ``6 fastest² / shortest``. Less than the largest half width, or there may be no next target.
    rest : float
        Time before the first and after the last move, s.
    """

    centre: FloatArray
    half_widths: FloatArray
    slowest: float
    fastest: float
    shortest: float
    rest: float


def draw_trajectory(
    start: FloatArray, moves: int, span: MoveRange, random: np.random.Generator
) -> Trajectory:
    """Draw a set of moves whose speed grows, then shrinks.

    Parameters
    ----------
    start : (D,) float64
        Where the set begins.
    moves : int
        Number of moves, at least 1.
    span : MoveRange
        Targets and speeds.
    random : numpy.random.Generator
        Source of the targets; the same state gives the same set.
    """
    if moves < 1:
        raise SimulationError(f"{moves} moves asked for; a motion has at least one")
    points = [np.zeros_like(start)]
    while len(points) <= moves:
        direction = random.standard_normal(start.size)
        radius = random.uniform(0.75, 1.0)
        target = span.centre + span.half_widths * direction * (radius / np.linalg.norm(direction))
        if np.linalg.norm(target - points[-1]) >= span.shortest:
            points.append(target)
    offsets = np.array(points)
    rise = np.sin(np.pi * np.arange(moves) / max(moves - 1, 1))
    speeds = span.slowest + (span.fastest - span.slowest) * rise
    times = np.linalg.norm(np.diff(offsets, axis=0), axis=1) / speeds
    starts = span.rest + np.concatenate([[0.0], np.cumsum(times)])
    return Trajectory(start + offsets, tuple(starts.tolist()), float(starts[-1] + span.rest))
