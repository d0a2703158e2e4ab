"""Limbs of a floating base without a sensor that all other limbs with the same joints have."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.model.tree import RobotModel

# Limbs that must have a sensor, so that the others count as like them.
FEWEST = 2

# Kinds and axes of a limb's joints, from its end to the base.
_Joints = tuple[tuple[str, tuple[float, ...]], ...]


def limbs_without_sensor(model: RobotModel, sensors: Sequence[str]) -> tuple[str, ...]:
    """Return names of the ends of limbs that lack a sensor, of a robot with a floating base.

    The limb of a sensor ends at the sensor's link. Others are like it if their joints have the
    same kinds, and the same axes apart from their signs.

    Parameters
    ----------
    model : RobotModel
    sensors : sequence of str
        Frames of the wrenches in a log.
    """
    if not model.floating:
        return ()
    frames = {frame.name: frame for frame in model.frames}
    ends = {frames[name].link: frames[name] for name in sensors if name in frames}
    inner = {joint.parent for joint in model.joints}
    found = []
    for link in range(1, len(model.links)):
        like = [at for at in ends if _joints(model, at) == _joints(model, link)]
        if link in ends or link in inner or len(like) < FEWEST:
            continue
        reach = float(np.linalg.norm(ends[like[0]].translation))
        own = [frame for frame in model.frames if frame.link == link]
        nearest = min(
            own,
            key=lambda frame: abs(float(np.linalg.norm(frame.translation)) - reach),
            default=None,
        )
        found.append(model.links[link].name if nearest is None else nearest.name)
    return tuple(found)


def joints_of_limbs(model: RobotModel, limbs: Sequence[str]) -> tuple[str, ...]:
    """Return the joints between the base and the frames or links at the ends of limbs."""
    links = [model.frame(name).link for name in limbs]
    return tuple(
        name
        for index, name in enumerate(model.joint_names)
        if any(model.ancestors[index, link] for link in links)
    )


def _joints(model: RobotModel, link: int) -> _Joints:
    """Return the joints between a link and the base."""
    joints = []
    while link:
        joint = model.joints[link - 1]
        axis = tuple(np.round(np.abs(joint.axis), 3).tolist())
        joints.append((joint.kind, axis))
        link = joint.parent
    return tuple(joints)
