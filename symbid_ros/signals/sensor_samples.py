"""Smoothed sensor channels of a segment and their derivatives."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import Smoothing
from symbid_ros.signals.segments import Segment


@dataclass(frozen=True)
class SensorSamples:
    """N samples of smoothed sensor channels, each in its sensor's own frame.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    position, velocity, acceleration, effort : (N, J) float64
        Joint channels in the model's order.
    imus : tuple of BaseMotion
        Angular velocity, angular acceleration and specific force of each IMU.
    wrenches : (N, F, 6) float64
        Moment and force of each sensor.
    imu_frames, wrench_frames : tuple of str
        Frames of the sensors.
    """

    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    imus: tuple[BaseMotion, ...]
    wrenches: FloatArray
    imu_frames: tuple[str, ...]
    wrench_frames: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, index: slice | IntArray) -> "SensorSamples":
        """Return the samples at some indices."""
        return replace(
            self,
            stamp=self.stamp[index],
            position=self.position[index],
            velocity=self.velocity[index],
            acceleration=self.acceleration[index],
            effort=self.effort[index],
            imus=tuple(
                BaseMotion(*(getattr(imu, field.name)[index] for field in fields(BaseMotion)))
                for imu in self.imus
            ),
            wrenches=self.wrenches[index],
        )

    def averaged(self, starts: IntArray) -> "SensorSamples":
        """Return the means over consecutive groups that begin at the indices ``starts``."""
        counts = np.diff(starts, append=len(self))

        def mean(values: FloatArray) -> FloatArray:
            shape = (-1,) + (1,) * (values.ndim - 1)
            average: FloatArray = np.add.reduceat(values, starts) / counts.reshape(shape)
            return average

        offset = (self.stamp - self.stamp[0]).astype(np.float64)
        return replace(
            self,
            stamp=self.stamp[0] + mean(offset).astype(np.int64),
            position=mean(self.position),
            velocity=mean(self.velocity),
            acceleration=mean(self.acceleration),
            effort=mean(self.effort),
            imus=tuple(
                BaseMotion(*(mean(getattr(imu, field.name)) for field in fields(BaseMotion)))
                for imu in self.imus
            ),
            wrenches=mean(self.wrenches),
        )


def smoothed(segment: Segment, smoothing: Smoothing, edge: int | None = None) -> SensorSamples:
    """Return a segment's samples without ``edge`` of them at each end, for the filter to settle."""
    rate = segment.rate
    if edge is None:
        edge = smoothing.settling(rate)
    if len(segment) <= 2 * edge:
        return _empty_samples(segment)
    position, velocity, acceleration = smoothing.motion(segment.position, rate, 2)
    imus = []
    for index in range(len(segment.imu_frames)):
        omega, alpha = smoothing.motion(segment.angular_velocity[:, index], rate, 1)
        force = smoothing.force(segment.linear_acceleration[:, index], rate)
        imus.append(BaseMotion(omega, alpha, force))
    readings = SensorSamples(
        stamp=segment.stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=smoothing.force(segment.effort, rate),
        imus=tuple(imus),
        wrenches=smoothing.force(segment.wrenches, rate),
        imu_frames=segment.imu_frames,
        wrench_frames=segment.wrench_frames,
    )
    return readings[edge : len(readings) - edge]


def _empty_samples(segment: Segment) -> SensorSamples:
    """Return zero samples, for a segment that is too short for the filter."""
    empty = segment.cut(0, 0)
    imu = BaseMotion(*(np.zeros((0, 3)) for _ in fields(BaseMotion)))
    return SensorSamples(
        stamp=empty.stamp,
        position=empty.position,
        velocity=empty.position,
        acceleration=empty.position,
        effort=empty.effort,
        imus=(imu,) * len(segment.imu_frames),
        wrenches=empty.wrenches,
        imu_frames=segment.imu_frames,
        wrench_frames=segment.wrench_frames,
    )


def at_base(readings: SensorSamples, model: RobotModel) -> Samples:
    """Return the samples of the equation of motion from sensor samples.

    Raises
    ------
    ModelError
        When a sensor's frame is not in the model.
    """
    base = _mean_base_motion(readings, model)
    return Samples(
        stamp=readings.stamp,
        position=model.apply_mimics(readings.position),
        velocity=model.apply_mimics(readings.velocity, rates=True),
        acceleration=model.apply_mimics(readings.acceleration, rates=True),
        effort=readings.effort,
        base_angular_velocity=base.angular_velocity,
        base_angular_acceleration=base.angular_acceleration,
        base_specific_force=base.specific_force,
        wrenches=readings.wrenches,
        wrench_frames=readings.wrench_frames,
    )


def _mean_base_motion(readings: SensorSamples, model: RobotModel) -> BaseMotion:
    if not model.floating:
        empty = np.zeros((len(readings), 3))
        return BaseMotion(empty, empty, np.broadcast_to(-model.gravity, empty.shape))
    joints = (
        model.apply_mimics(readings.position),
        model.apply_mimics(readings.velocity, rates=True),
        model.apply_mimics(readings.acceleration, rates=True),
    )
    motions = [
        base_motion(model, frame, joints, imu)
        for frame, imu in zip(readings.imu_frames, readings.imus, strict=True)
    ]
    # The mean of several IMUs on the same base has the least noise.
    return BaseMotion(
        *(
            np.mean([getattr(motion, field.name) for motion in motions], axis=0)
            for field in fields(BaseMotion)
        )
    )


def build_samples(
    segments: Sequence[Segment], model: RobotModel, smoothing: Smoothing, source: str
) -> Samples:
    """Return the samples of the equation of motion of a log.

    Parameters
    ----------
    segments : sequence of Segment
        Aligned segments of one recording.
    model : RobotModel
        Kinematics and frames; its inertias are not used.
    smoothing : Smoothing
        Filter and differentiator of the measured channels.
    source : str
        Name of the recording for messages.

    Raises
    ------
    DataError
        When the log is too short.
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
            f"{source}: the log is too short for this filter ({smoothing}) to settle; "
            "raise its cutoff, shorten its window or record longer",
            "E318",
        )
    return samples


def _by_measured_efforts(segment: Segment, shortest: int) -> Iterator[Segment]:
    """Cut a segment where efforts become NaN or finite, because filters do not accept NaN."""
    lost = np.isnan(segment.effort)
    changes = np.flatnonzero(np.any(lost[1:] != lost[:-1], axis=1)) + 1
    if not len(changes):
        yield segment
        return
    for start, stop in pairwise([0, *changes.tolist(), len(segment)]):
        if stop - start > shortest:
            yield segment.cut(start, stop)


def joined(parts: Sequence[Samples]) -> Samples:
    """Concatenate the samples of several segments."""
    arrays = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Samples)
        if field.name != "wrench_frames"
    }
    return Samples(**arrays, wrench_frames=parts[0].wrench_frames)
