"""Smoothed sensor channels of a segment and their derivatives."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, concatenated, map_arrays
from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.decimation import Decimator
from symbid_ros.signals.filters import LowPass, Smoothing
from symbid_ros.signals.segments import Segment

# Seconds between the instants at which sensor noise is propagated to the rows.
PROBE_PERIOD = 0.05


@dataclass(frozen=True)
class RecordedPositions:
    """Joint positions at the full rate, from which samples at a lower rate were made.

    Attributes
    ----------
    position : (M, J) float64
        As recorded.
    decimator : Decimator
        Filters them and reduces their rate.
    """

    position: FloatArray
    decimator: Decimator

    def motion(self) -> tuple[FloatArray, FloatArray]:
        """Return filtered positions and velocities at the full rate, where the filter settled."""
        edge = self.decimator.edge
        settled = slice(edge, len(self.position) - edge)
        position, velocity = self.decimator.every(self.position, 1)
        return position[settled], velocity[settled]


@dataclass(frozen=True)
class SensorSamples:
    """N samples of smoothed sensor channels, each in its sensor's own frame.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    position, velocity, acceleration, effort : (N, J) float64
        Joint channels in the model's order.
    angular_velocity, angular_acceleration, specific_force : (N, I, 3) float64
        Of each IMU, in rad/s, rad/s² and m/s².
    wrenches : (N, F, 6) float64
        Moment and force of each sensor.
    imu_frames, wrench_frames : tuple of str
        Frames of the sensors.
    touching : (N, C) bool or None
        Which contacts without a sensor touch something; None if all may.
    recorded : RecordedPositions or None
        Positions at the full rate, if the samples are of a lower one; slices lose them.
    """

    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    wrenches: FloatArray
    imu_frames: tuple[str, ...]
    wrench_frames: tuple[str, ...]
    touching: BoolArray | None = None
    recorded: RecordedPositions | None = None

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, index: slice | IntArray) -> "SensorSamples":
        """Return the samples at some indices."""
        return replace(map_arrays(self, lambda values: values[index]), recorded=None)

    def averaged(self, starts: IntArray) -> "SensorSamples":
        """Return the means over consecutive groups that begin at the indices ``starts``.

        A contact that touches at any time of a group touches.
        """
        counts = np.diff(starts, append=len(self))

        def mean(values: NDArray[Any]) -> NDArray[Any]:
            if values.dtype == bool:
                touches: BoolArray = np.logical_or.reduceat(values, starts)
                return touches
            shape = (-1,) + (1,) * (values.ndim - 1)
            average: FloatArray = np.add.reduceat(values, starts) / counts.reshape(shape)
            return average

        # The sum of large stamps would overflow.
        means = map_arrays(replace(self, stamp=self.stamp - self.stamp[0], recorded=None), mean)
        return replace(means, stamp=self.stamp[0] + means.stamp.astype(np.int64))


def smoothed(segment: Segment, smoothing: Smoothing, edge: int | None = None) -> SensorSamples:
    """Return a segment's samples without ``edge`` of them at each end, for the filter to settle.

    A segment that is too short gives zero samples.
    """
    rate = segment.rate
    if edge is None:
        edge = smoothing.settling(rate)
    if len(segment) <= 2 * edge:
        segment, edge = segment.cut(0, 0), 0
    position, velocity, acceleration = smoothing.motion(segment.position, rate, 2)
    angular_velocity, angular_acceleration = smoothing.motion(segment.angular_velocity, rate, 1)
    readings = SensorSamples(
        stamp=segment.stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=smoothing.force(segment.effort, rate),
        angular_velocity=angular_velocity,
        angular_acceleration=angular_acceleration,
        specific_force=smoothing.force(segment.linear_acceleration, rate),
        wrenches=smoothing.force(segment.wrenches, rate),
        imu_frames=segment.imu_frames,
        wrench_frames=segment.wrench_frames,
        touching=segment.touching,
    )
    return readings[edge : len(readings) - edge]


def decimated(
    segment: Segment,
    decimator: Decimator,
    similar: tuple[Segment, SensorSamples] | None = None,
) -> SensorSamples:
    """Return a segment's samples at the lower rate of a decimator.

    ``similar`` may give a segment that shares some arrays with this one, and its samples.
    """
    edge, stride = decimator.edge, decimator.stride
    kept = slice(edge, len(segment) - edge, stride)

    def motion(channel: str, *names: str) -> dict[str, FloatArray]:
        signal = getattr(segment, channel)
        if similar is not None and getattr(similar[0], channel) is signal:
            return {name: getattr(similar[1], name) for name in names}
        return dict(zip(names, decimator.motion(signal, len(names) - 1), strict=True))

    return SensorSamples(
        stamp=segment.stamp[kept],
        **motion("position", "position", "velocity", "acceleration"),
        **motion("effort", "effort"),
        **motion("angular_velocity", "angular_velocity", "angular_acceleration"),
        **motion("linear_acceleration", "specific_force"),
        **motion("wrenches", "wrenches"),
        imu_frames=segment.imu_frames,
        wrench_frames=segment.wrench_frames,
        touching=None if segment.touching is None else segment.touching[kept],
        recorded=RecordedPositions(segment.position, decimator),
    )


def at_base(readings: SensorSamples, model: RobotModel) -> Samples:
    """Return the samples of the equation of motion from sensor samples.

    Raises
    ------
    ModelError
        When a sensor's frame is not in the model.
    """
    position = model.apply_mimics(readings.position)
    velocity = model.apply_mimics(readings.velocity, rates=True)
    acceleration = model.apply_mimics(readings.acceleration, rates=True)
    base = _mean_base_motion(readings, model, (position, velocity, acceleration))
    return Samples(
        stamp=readings.stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=readings.effort,
        base_angular_velocity=base.angular_velocity,
        base_angular_acceleration=base.angular_acceleration,
        base_specific_force=base.specific_force,
        wrenches=readings.wrenches,
        wrench_frames=readings.wrench_frames,
        touching=readings.touching,
    )


def probed(segment: Segment, model: RobotModel, period: float = PROBE_PERIOD) -> Samples:
    """Return unfiltered samples of a segment at few instants, ``period`` seconds apart."""
    stride = max(1, int(period * segment.rate))
    unfiltered = LowPass(0)
    # Derivatives need some samples on either side. The copies do not keep these in memory.
    edge = unfiltered.settling(segment.rate)
    places = np.arange(edge, len(segment) - edge, stride)
    near = places + np.arange(-edge, edge + 1)[:, None]
    readings = smoothed(map_arrays(segment, lambda values: values[near]), unfiltered)
    return at_base(map_arrays(readings, lambda values: values[0].copy()), model)


def _mean_base_motion(
    readings: SensorSamples,
    model: RobotModel,
    joints: tuple[FloatArray, FloatArray, FloatArray],
) -> BaseMotion:
    if not model.floating:
        empty = np.zeros((len(readings), 3))
        return BaseMotion(empty, empty, np.broadcast_to(-model.gravity, empty.shape))
    imus = (readings.angular_velocity, readings.angular_acceleration, readings.specific_force)
    motions = [
        base_motion(model, frame, joints, BaseMotion(*(values[:, index] for values in imus)))
        for index, frame in enumerate(readings.imu_frames)
    ]
    # The mean of several IMUs on the same base has the least noise.
    return BaseMotion(
        np.mean([motion.angular_velocity for motion in motions], axis=0),
        np.mean([motion.angular_acceleration for motion in motions], axis=0),
        np.mean([motion.specific_force for motion in motions], axis=0),
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
    samples = concatenated(parts)
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
