"""Moments that sensors of forces alone leave out, where the model tells what they are.

The ground touches a ball at its lowest point, not at its centre, about which frames of feet often
are. A force f there has the moment r × f about the centre, with r from the centre downwards.
"""

from dataclasses import replace

import numpy as np

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.upright import upward
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import at_base, smoothed


def with_moments_of_balls(segment: Segment, model: RobotModel) -> Segment:
    """Return a segment with the moments of forces on balls, where a sensor reads none at all.

    Moments that are zero throughout were not measured: a foot that touches with friction has some
    about its centre.
    """
    frames = [model.frame(name) for name in segment.wrench_frames]
    places = [
        index
        for index, frame in enumerate(frames)
        if frame.radius and not segment.wrenches[:, index, :3].any()
    ]
    if not places:
        return segment
    samples = at_base(smoothed(segment, LowPass(0), edge=0), model)
    up, poses = upward(samples), link_poses(model, samples.position)
    wrenches = segment.wrenches.copy()
    for index in places:
        frame = frames[index]
        axes = poses.rotation[:, frame.link] @ frame.rotation
        down = -frame.radius * np.einsum("tji,tj->ti", axes, up)
        wrenches[:, index, :3] = np.cross(down, wrenches[:, index, 3:])
    return replace(segment, wrenches=wrenches)
