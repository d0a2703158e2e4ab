"""What the sensors of one stretch say once smoothed, with the derivatives that are needed."""

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
    """N instants of smoothed sensor channels, each in its sensor's own frame.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    position, velocity, acceleration, effort : (N, J) float64
        Of the joints, in the model's order.
    imus : tuple of BaseMotion
        Angular velocity, angular acceleration and specific force of each IMU.
    wrenches : (N, F, 6) float64
        Moment and force of each sensor.
    imu_frames, wrench_frames : tuple of str
        Where the sensors are.
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
        """Return the readings of some of the instants."""
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
        """Return the means of the stretches that begin at ``starts``."""
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
    """Return a stretch's readings, less ``edge`` of them at its ends, which feel the edge."""
    rate = segment.rate
    if edge is None:
        edge = smoothing.settling(rate)
    if len(segment) <= 2 * edge:
        return _no_readings(segment)
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


def _no_readings(segment: Segment) -> SensorSamples:
    """Return what is left of a stretch that is all edge, which filters may refuse."""
    nothing = segment.cut(0, 0)
    imu = BaseMotion(*(np.zeros((0, 3)) for _ in fields(BaseMotion)))
    return SensorSamples(
        stamp=nothing.stamp,
        position=nothing.position,
        velocity=nothing.position,
        acceleration=nothing.position,
        effort=nothing.effort,
        imus=(imu,) * len(segment.imu_frames),
        wrenches=nothing.wrenches,
        imu_frames=segment.imu_frames,
        wrench_frames=segment.wrench_frames,
    )


def at_base(readings: SensorSamples, model: RobotModel) -> Samples:
    """Return the samples of the equation of motion that the readings make.

    Raises
    ------
    ModelError
        When a sensor's frame is not in the model.
    """
    base = _base(readings, model)
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


def _base(readings: SensorSamples, model: RobotModel) -> BaseMotion:
    if not model.floating:
        nothing = np.zeros((len(readings), 3))
        return BaseMotion(nothing, nothing, np.broadcast_to(-model.gravity, nothing.shape))
    joints = (
        model.apply_mimics(readings.position),
        model.apply_mimics(readings.velocity, rates=True),
        model.apply_mimics(readings.acceleration, rates=True),
    )
    motions = [
        base_motion(model, frame, joints, imu)
        for frame, imu in zip(readings.imu_frames, readings.imus, strict=True)
    ]
    # Several IMUs see the same base; their mean is the least noisy of equals.
    return BaseMotion(
        *(
            np.mean([getattr(motion, field.name) for motion in motions], axis=0)
            for field in fields(BaseMotion)
        )
    )


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
            "left once it has settled; raise its cutoff, shorten it or record longer",
            "E318",
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


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several stretches one after the other."""
    arrays = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Samples)
        if field.name != "wrench_frames"
    }
    return Samples(**arrays, wrench_frames=parts[0].wrench_frames)
