"""Frames fixed to links, and the balls about them that can touch the ground."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray

AT_CENTER = 1e-3  # m between a frame's origin and the centre of its ball


@dataclass(frozen=True)
class Frame:
    """A frame fixed to a link, such as an IMU or a sole.

    Attributes
    ----------
    name : str
        Frame name, as in ``header.frame_id``.
    link : int
        Index of the link that carries it.
    rotation, translation : (3, 3) and (3,) float64
        Pose of the frame in the link's frame.
    radius : float
        Of the ball about its origin that can touch the ground, m; zero if there is none.
    below : float
        How far below its origin the force of its sensor acts if that measures no moments, m; zero
        for other sensors.
    """

    name: str
    link: int
    rotation: FloatArray
    translation: FloatArray
    radius: float = 0.0
    below: float = 0.0


def with_radii_of_balls(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """Return frames sorted by name, of which all at the centre of a ball have its radius."""
    frames = sorted(frames, key=lambda frame: frame.name)
    balls = [frame for frame in frames if frame.radius]

    def radius(frame: Frame) -> float:
        near = (ball.radius for ball in balls if _distance(frame, ball) < AT_CENTER)
        return frame.radius or next(near, 0.0)

    return tuple(replace(frame, radius=radius(frame)) for frame in frames)


def ball_around(frame: Frame, frames: Iterable[Frame]) -> Frame | None:
    """Return the one of ``frames`` whose ball contains a frame's origin, or None.

    A frame at the centre of a ball is returned as it is.
    """
    if frame.radius:
        return frame
    balls = [one for one in frames if _distance(one, frame) < one.radius + AT_CENTER]
    return min(
        (one for one in balls if one.radius), key=lambda one: _distance(one, frame), default=None
    )


def _distance(first: Frame, second: Frame) -> float:
    """Return the distance of two frames' origins, m; infinite between links."""
    if first.link != second.link:
        return np.inf
    return float(np.linalg.norm(first.translation - second.translation))
