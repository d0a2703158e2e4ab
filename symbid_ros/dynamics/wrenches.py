"""Wrenches of sensor frames in base axes."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, component_first, cross, sample_first
from symbid_ros.model.tree import RobotModel


def wrenches_at_base(
    model: RobotModel, wrenches: FloatArray, frames: Sequence[str], poses: LinkPoses
) -> FloatArray:
    """Return wrenches (N, F, 6) of sensor frames in base axes about the base's origin."""
    mounts = [model.frame(name) for name in frames]
    links = [mount.link for mount in mounts]
    mount_rotation = np.array([mount.rotation for mount in mounts]).reshape(-1, 3, 3)
    lever = np.array([mount.translation for mount in mounts]).reshape(-1, 3).T
    in_sensor = component_first(wrenches).reshape(2, 3, len(frames), len(wrenches))
    in_link = np.einsum("fij,kjfn->kifn", mount_rotation, in_sensor)
    in_link[0] += cross(lever[:, :, None], in_link[1])
    rotation = component_first(poses.rotation[:, links])
    at_base = np.einsum("ijfn,kjfn->kifn", rotation, in_link)
    at_base[0] += cross(component_first(poses.position[:, links]), at_base[1])
    return sample_first(at_base.reshape(6, len(frames), len(wrenches)))
