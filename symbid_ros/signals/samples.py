"""Streams to samples: aligned, filtered, differentiated, carried to the base."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import Segment, align
from symbid_ros.signals.filters import Smoothing
from symbid_ros.signals.readings import at_base, smoothed
from symbid_ros.signals.streams import Streams


def build_samples(
    segments: Sequence[Segment], model: RobotModel, smoothing: Smoothing, source: str
) -> Samples:
    """Return the samples that the equation of motion is written for.

    Parameters
    ----------
    segments : sequence of Segment
        Aligned stretches of one recording.
    model : RobotModel
        Kinematics and frames; its inertias are not looked at.
    smoothing : Smoothing
        Filter and differentiator of the measured channels.
    source : str
        The recording's name, for messages.

    Raises
    ------
    DataError
        When the record is too short.
    ModelError
        When a sensor's frame is not in the model.
    """
    parts = []
    for segment in segments:
        samples = at_base(smoothed(segment, smoothing), model)
        parts.append(samples[:: smoothing.stride(segment.rate)])
    samples = joined(parts)
    if len(samples) == 0:
        raise DataError(
            f"{source}: the log is too short for this filter ({smoothing}), nothing is "
            "left once it has settled; raise its cutoff, shorten it or record longer"
        )
    return samples


def moving_segments(streams: Streams, model: RobotModel) -> tuple[Segment, ...]:
    """Return the aligned stretches of a recording that can tell how the base moves.

    Raises
    ------
    DataError
        When a floating robot has no IMU or the record is too short.
    ModelError
        When a joint is not in the model.
    """
    if model.floating and not streams.imus:
        raise DataError(
            f"{streams.source}: {model.source} floats but the bag has no sensor_msgs/msg/Imu "
            "topic; record the IMU, or say that the base is fixed"
        )
    return align(streams, model)


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several stretches one after the other."""
    arrays = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Samples)
        if field.name != "wrench_frames"
    }
    return Samples(**arrays, wrench_frames=parts[0].wrench_frames)
