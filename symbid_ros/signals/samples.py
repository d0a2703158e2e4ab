"""Streams to samples: aligned, filtered, differentiated, carried to the base."""

from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import pairwise

import numpy as np

from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import Segment, align
from symbid_ros.signals.filters import Smoothing
from symbid_ros.signals.readings import at_base, smoothed
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream


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
        for part in _by_measured_efforts(segment, 2 * smoothing.settling(segment.rate)):
            samples = at_base(smoothed(part, smoothing), model)
            parts.append(samples[:: smoothing.stride(segment.rate)])
    samples = joined(parts)
    if len(samples) == 0:
        raise DataError(
            f"{source}: the log is too short for this filter ({smoothing}), nothing is "
            "left once it has settled; raise its cutoff, shorten it or record longer"
        )
    return samples


def _by_measured_efforts(segment: Segment, shortest: int) -> Iterator[Segment]:
    """Cut a stretch where the joints change whose effort was measured: no filter passes NaN."""
    lost = np.isnan(segment.effort)
    changes = np.flatnonzero(np.any(lost[1:] != lost[:-1], axis=1)) + 1
    if not len(changes):
        yield segment
        return
    for start, stop in pairwise([0, *changes.tolist(), len(segment)]):
        if stop - start > shortest:
            yield segment.cut(start, stop)


def moving_segments(streams: Streams, model: RobotModel) -> tuple[Segment, ...]:
    """Return the aligned stretches of a recording that can tell how the base moves.

    Raises
    ------
    DataError
        When a floating robot has no IMU or the record is too short.
    ModelError
        When a joint or a sensor's frame is not in the model.
    """
    if model.floating and not streams.imus:
        raise DataError(
            f"{streams.source}: the base of {model.source} floats, but the bag has no "
            "sensor_msgs/msg/Imu topic; record the IMU, or give --base fixed if it is bolted down"
        )
    sensors: list[ImuStream | WrenchStream] = [
        *(streams.imus if model.floating else ()),
        *streams.wrenches,
    ]
    for sensor in sensors:
        _check_frame(sensor, model, streams.source)
    return align(streams, model)


def _check_frame(sensor: ImuStream | WrenchStream, model: RobotModel, source: str) -> None:
    """Refuse a sensor whose frame the model lacks, and suggest the prefix that it may have."""
    frame = sensor.frame_id
    try:
        model.frame(frame)
    except ModelError as error:
        prefix = suggested_prefix(frame, model)
        if not prefix:
            raise ModelError(f"{source}: {sensor.topic}: {error}") from error
        raise ModelError(
            f"{source}: {sensor.topic}: frame {frame!r} is not in model {model.source}, but "
            f"{frame.removeprefix(prefix)!r} is; give --frame-prefix {prefix} (parameter "
            f"frame_prefix:={prefix})"
        ) from error


def suggested_prefix(frame: str, model: RobotModel) -> str:
    """Return what to remove from a sensor's frame to get one of the model's; empty if nothing."""
    known = {*(one.name for one in model.frames), *model.link_names}
    cuts = [index + 1 for index, letter in enumerate(frame) if letter == "/"]
    return next((frame[:cut] for cut in cuts if frame[cut:] in known), "")


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several stretches one after the other."""
    arrays = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Samples)
        if field.name != "wrench_frames"
    }
    return Samples(**arrays, wrench_frames=parts[0].wrench_frames)
