"""Streams to samples: aligned, filtered, differentiated, carried to the base."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import Segment, align
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.streams import Streams


def build_samples(streams: Streams, model: RobotModel, low_pass: LowPass) -> Samples:
    """Return the samples that the equation of motion is written for.

    Parameters
    ----------
    streams : Streams
        Sensor streams of one recording.
    model : RobotModel
        Kinematics and frames; its inertias are not looked at.
    low_pass : LowPass
        Filter of the measured channels.

    Raises
    ------
    DataError
        When a floating robot has no IMU or the record is too short.
    ModelError
        When a joint or a sensor's frame is not in the model.
    """
    if model.floating and not streams.imus:
        raise DataError(
            f"{streams.source}: {model.source} floats but the bag has no sensor_msgs/msg/Imu "
            "topic; record the IMU, or say that the base is fixed"
        )
    segments = align(streams, model)
    parts = [_segment_samples(segment, streams, model, low_pass) for segment in segments]
    samples = _joined(parts)
    if len(samples) == 0:
        raise DataError(
            f"{streams.source}: the log is too short for a cutoff of {low_pass.cutoff:g} Hz, "
            "nothing is left once the filter has settled; record longer or raise the cutoff"
        )
    return samples


def _segment_samples(
    segment: Segment, streams: Streams, model: RobotModel, low_pass: LowPass
) -> Samples:
    rate = segment.rate
    position = low_pass.motion(segment.position, rate)
    velocity = low_pass.derivative(position, rate)
    acceleration = low_pass.derivative(velocity, rate)
    base = _base(segment, streams, model, low_pass, (position, velocity, acceleration))
    samples = Samples(
        stamp=segment.stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=low_pass.force(segment.effort, rate),
        base_angular_velocity=base.angular_velocity,
        base_angular_acceleration=base.angular_acceleration,
        base_specific_force=base.specific_force,
        wrenches=low_pass.force(segment.wrenches, rate),
        wrench_frames=tuple(wrench.frame_id for wrench in streams.wrenches),
    )
    edge = low_pass.settling(rate)
    return samples[edge : max(edge, len(samples) - edge) : low_pass.stride(rate)]


def _base(
    segment: Segment,
    streams: Streams,
    model: RobotModel,
    low_pass: LowPass,
    joints: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> BaseMotion:
    if not model.floating:
        nothing = np.zeros((len(segment.stamp), 3))
        return BaseMotion(nothing, nothing, np.broadcast_to(-model.gravity, nothing.shape))
    motions = []
    for index, imu in enumerate(streams.imus):
        rate_of_turn = low_pass.motion(segment.angular_velocity[:, index], segment.rate)
        reading = BaseMotion(
            rate_of_turn,
            low_pass.derivative(rate_of_turn, segment.rate),
            low_pass.force(segment.linear_acceleration[:, index], segment.rate),
        )
        motions.append(base_motion(model, imu.frame_id, joints, reading))
    # Several IMUs see the same base; their mean is the least noisy of equals.
    return BaseMotion(
        *(
            np.mean([getattr(motion, field.name) for motion in motions], axis=0)
            for field in fields(BaseMotion)
        )
    )


def _joined(parts: Sequence[Samples]) -> Samples:
    arrays = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Samples)
        if field.name != "wrench_frames"
    }
    return Samples(**arrays, wrench_frames=parts[0].wrench_frames)
