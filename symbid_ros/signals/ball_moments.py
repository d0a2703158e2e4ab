"""Moments that foot sensors of forces alone leave out, where the model tells what they are.

The ground touches a ball at its lowest point, not at its centre, about which the frames of feet
often are. A force f there has the moment r × f about the centre, with r from the centre downwards.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.upright import upward
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import at_base, smoothed
from symbid_ros.signals.weak_form import block_length


def frames_without_moments(segment: Segment, model: RobotModel) -> frozenset[str]:
    """Return the frames at centres of balls whose sensors read forces and no moments at all."""
    return frozenset(
        name
        for index, name in enumerate(segment.wrench_frames)
        if model.frame(name).radius
        and segment.wrenches[:, index, 3:].any()
        and not segment.wrenches[:, index, :3].any()
    )


def with_moments_of_balls(segment: Segment, model: RobotModel) -> Segment:
    """Return a segment with the moments of forces that act below the origins of their frames.

    They replace the readings of sensors that measure forces alone (``Frame.below``).
    """
    frames = [model.frame(name) for name in segment.wrench_frames]
    places = [index for index, frame in enumerate(frames) if frame.below]
    if not places:
        return segment
    samples = at_base(smoothed(segment, LowPass(0), edge=0), model)
    # Blocks begin at the same stamps however a log is read. In longer ones the gyroscope drifts.
    blocks = np.flatnonzero(np.diff(segment.stamp // block_length(segment.rate))) + 1
    parts = pairwise([0, *blocks.tolist(), len(samples)])
    up = np.concatenate([upward(samples[start:stop]) for start, stop in parts])
    poses = link_poses(model, samples.position)
    wrenches = segment.wrenches.copy()
    for index in places:
        frame = frames[index]
        axes = poses.rotation[:, frame.link] @ frame.rotation
        down = -frame.below * np.einsum("tji,tj->ti", axes, up)
        wrenches[:, index, :3] = np.cross(down, wrenches[:, index, 3:])
    return replace(segment, wrenches=wrenches)
