"""Frames that a log says are fixed to links of a robot, as on ``/tf_static``."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.frames import Frame, with_radii_of_balls
from symbid_ros.model.rotation import rotation_from_xyzw
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class FixedTransform:
    """A frame that is fixed to another one.

    Attributes
    ----------
    parent, child : str
        Frames.
    rotation : (3, 3) float64
        From the child's axes to the parent's.
    translation : (3,) float64
        Origin of the child in the parent, m.
    """

    parent: str
    child: str
    rotation: FloatArray
    translation: FloatArray

    def inverse(self) -> "FixedTransform":
        """Return the transform of the parent in the child."""
        turned = self.rotation.T
        return FixedTransform(self.child, self.parent, turned, -turned @ self.translation)


def with_fixed_frames(model: RobotModel, transforms: Collection[FixedTransform]) -> RobotModel:
    """Return a robot with the frames that chains of transforms fix to one of its links or frames.

    Frames and links that the model has already stay as they are.
    """
    known = {one.name: one for one in model.frames}
    known |= {name: model.frame(name) for name in model.link_names if name not in known}
    added: list[Frame] = []
    ends = [*transforms, *(one.inverse() for one in transforms)]
    reached = list(known)
    while reached:
        name = reached.pop()
        for one in ends:
            if one.parent != name or one.child in known:
                continue
            at = known[name]
            frame = Frame(
                one.child,
                at.link,
                at.rotation @ one.rotation,
                at.rotation @ one.translation + at.translation,
            )
            known[one.child] = frame
            added.append(frame)
            reached.append(one.child)
    if not added:
        return model
    return replace(model, frames=with_radii_of_balls([*model.frames, *added]))


def with_frames_of(model: RobotModel, other: RobotModel) -> RobotModel:
    """Return a robot with those frames of another one of the same bodies that it lacks."""
    known = {one.name for one in model.frames} | set(model.link_names)
    lacking = []
    for frame in other.frames:
        link = other.links[frame.link].name
        if frame.name not in known and link in known:
            lacking.append(FixedTransform(link, frame.name, frame.rotation, frame.translation))
    return with_fixed_frames(model, lacking)


def transform_of_quaternion(
    parent: str, child: str, xyzw: FloatArray, translation: FloatArray
) -> FixedTransform | None:
    """Return a transform from a ROS message; None if rotation or position is invalid."""
    norm = float(np.linalg.norm(xyzw))
    if not (np.isfinite(norm) and norm > 0.5 and np.isfinite(translation).all()):
        return None
    return FixedTransform(parent, child, rotation_from_xyzw(xyzw / norm), translation)
