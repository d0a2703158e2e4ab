"""Streams with clocks of their own, brought onto one uniform clock.

The joint states give the clock. Where every stream was sampled at its ticks the
numbers pass untouched; elsewhere a cubic spline is evaluated. Nothing is invented
across a gap: there the record is cut into segments.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.efforts import MeasuredEfforts, measured_efforts
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream

logger = logging.getLogger(__name__)

# A stream may miss this many periods in a row before the record is cut.
LONGEST_GAP = 5.5
SHORTEST_SEGMENT = 50

# Beyond the ends of a stretch, ns: what a spline needs that resamples a slower topic. What a sample
# contributes falls by a factor of four from one sample to the next.
MARGIN = 100_000_000
LONGEST_MARGIN = 1_000_000_000
SAMPLES_PER_MARGIN = 20


@dataclass(frozen=True)
class _Channel:
    """One stream as a matrix: ``topic`` for messages, values (N, c) at ``stamp`` (N,)."""

    topic: str
    stamp: IntArray
    values: FloatArray


def align(streams: Streams, model: RobotModel) -> tuple[Segment, ...]:
    """Bring all streams onto the clock of the joint states.

    Raises
    ------
    DataError
        When the streams do not overlap or every stretch is too short.
    ModelError
        When the bag's joints are not the model's.
    """
    stamps = [(streams.joints.topic, streams.joints.stamp)]
    stamps += [(imu.topic, imu.stamp) for imu in streams.imus]
    stamps += [(wrench.topic, wrench.stamp) for wrench in streams.wrenches]
    for topic, stamp in stamps:
        if not len(stamp):
            raise DataError(
                f"{streams.source}: {topic} has no usable message; check its driver, or leave the "
                "topic out"
            )
    joints, efforts = _joint_channel(streams, model)
    channels = [joints, *map(_imu_channel, streams.imus), *map(_wrench_channel, streams.wrenches)]
    period = _period(joints, streams)
    start = max(int(channel.stamp[0]) for channel in channels)
    stop = min(int(channel.stamp[-1]) for channel in channels)
    if stop <= start:
        topics = ", ".join(channel.topic for channel in channels)
        raise DataError(
            f"{streams.source}: the topics {topics} share no time; check their clocks and stamps"
        )
    segments = tuple(
        _segment(channels, grid, period, streams, efforts)
        for grid in _grids(channels, start, stop, period)
    )
    if not segments:
        nowhere = f"no stretch of {SHORTEST_SEGMENT} samples has data on every topic"
        if streams.is_live:
            raise DataError(f"{streams.source}: {nowhere}; check their drivers for gaps")
        raise DataError(f"{streams.source}: the log is too short, {nowhere}; record longer")
    return segments


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
            "sensor_msgs/msg/Imu topic; record the IMU, or give `base` fixed if it is bolted down"
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
            f"{frame.removeprefix(prefix)!r} is; give `frame_prefix` {prefix}"
        ) from error


def suggested_prefix(frame: str, model: RobotModel) -> str:
    """Return what to remove from a sensor's frame to get one of the model's; empty if nothing."""
    known = {*(one.name for one in model.frames), *model.link_names}
    cuts = [index + 1 for index, letter in enumerate(frame) if letter == "/"]
    return next((frame[:cut] for cut in cuts if frame[cut:] in known), "")


def resampling_margin(topics: Iterable[IntArray]) -> int:
    """Return how far beyond a stretch's ends its topics must reach, ns, by their stamps (N,)."""
    steps = [np.diff(np.unique(stamp)) for stamp in topics]
    periods = [float(np.median(each)) for each in steps if len(each)]
    needed = round(SAMPLES_PER_MARGIN * max(periods, default=0.0))
    return min(max(MARGIN, needed), LONGEST_MARGIN)


def _period(joints: _Channel, streams: Streams) -> float:
    """Return the joint states' sampling period in nanoseconds."""
    if len(joints.stamp) < SHORTEST_SEGMENT:
        action = "publish at a higher rate" if streams.is_live else "record longer"
        raise DataError(
            f"{streams.source}: {joints.topic}: {len(joints.stamp)} joint states are too few, at "
            f"least {SHORTEST_SEGMENT} are needed; {action}"
        )
    return float(np.median(np.diff(joints.stamp)))


def _grids(channels: Sequence[_Channel], start: int, stop: int, period: float) -> list[IntArray]:
    """Return the uniform clocks of the stretches in which no stream has a gap."""
    cuts: list[tuple[int, int]] = []
    for channel in channels:
        steps = np.diff(channel.stamp)
        longest = LONGEST_GAP * max(period, float(np.median(steps)))
        late = np.flatnonzero(steps > longest)
        cuts += zip(channel.stamp[late].tolist(), channel.stamp[late + 1].tolist(), strict=True)
    edges = [start, *(edge for cut in _merged(cuts) for edge in cut), stop]
    grids = []
    ticks = channels[0].stamp
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        # Start on a tick of the joint states, so that a regular log needs no interpolation.
        first = np.searchsorted(ticks, begin)
        if first < len(ticks) and ticks[first] <= end:
            count = int((end - ticks[first]) / period + 1e-6) + 1
            if count >= SHORTEST_SEGMENT:
                grids.append(ticks[first] + np.rint(np.arange(count) * period).astype(np.int64))
    return grids


def _merged(cuts: list[tuple[int, int]]) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for begin, end in sorted(cuts):
        if merged and begin <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    return merged


def _segment(
    channels: Sequence[_Channel],
    grid: IntArray,
    period: float,
    streams: Streams,
    efforts: MeasuredEfforts,
) -> Segment:
    joints = efforts.values.shape[1]
    position_and_effort, *others = (_resampled(channel, grid) for channel in channels)
    imus, wrenches = others[: len(streams.imus)], others[len(streams.imus) :]
    count = len(grid)
    readings = np.stack(imus, axis=1) if imus else np.zeros((count, 0, 6))
    return Segment(
        stamp=grid,
        rate=1e9 / period,
        position=position_and_effort[:, :joints],
        effort=efforts.masked(grid, position_and_effort[:, joints:]),
        angular_velocity=readings[:, :, :3],
        linear_acceleration=readings[:, :, 3:],
        wrenches=np.stack(wrenches, axis=1) if wrenches else np.zeros((count, 0, 6)),
        imu_frames=tuple(imu.frame_id for imu in streams.imus),
        wrench_frames=tuple(wrench.frame_id for wrench in streams.wrenches),
    )


def _resampled(channel: _Channel, grid: IntArray) -> FloatArray:
    """Return the channel's values (M, c) at the grid's stamps."""
    first = int(np.searchsorted(channel.stamp, grid[0]))
    here = channel.stamp[first : first + len(grid)]
    if len(here) == len(grid) and np.array_equal(here, grid):
        return channel.values[first : first + len(grid)]
    low = max(0, int(np.searchsorted(channel.stamp, grid[0], side="right")) - 3)
    high = int(np.searchsorted(channel.stamp, grid[-1])) + 3
    stamp, values = channel.stamp[low:high], channel.values[low:high]
    seconds = (stamp - grid[0]) * 1e-9
    spline = make_interp_spline(seconds, values, k=min(3, len(stamp) - 1))
    resampled: FloatArray = spline((grid - grid[0]) * 1e-9)
    return resampled


def _joint_channel(streams: Streams, model: RobotModel) -> tuple[_Channel, MeasuredEfforts]:
    """Return positions and efforts of the model's joints side by side, and which were measured."""
    joints = streams.joints
    topic = f"{streams.source}: {joints.topic}"
    columns = joint_columns(joints.names, model, topic)
    stamp, position = joints.stamp, model.apply_mimics(joints.position[:, columns])
    is_finite = np.isfinite(position)
    whole = np.logical_and.reduce(is_finite, axis=1)
    if 0 < 2 * np.count_nonzero(~whole) >= len(whole):
        row, column = np.argwhere(~is_finite)[0]
        action = "let its driver publish it"
        if not streams.is_live:
            action += ", leave that part of the bag out (`start`, `stop`)"
        raise DataError(
            f"{topic} has no finite position of joint {model.joint_names[column]!r} at "
            f"{stamp[row] * 1e-9:.3f} s, as in half of the messages or more; {action}, or give a "
            "model in which that joint is fixed"
        )
    if not whole.all():
        names = [model.joint_names[i] for i in np.flatnonzero(~is_finite.all(axis=0))]
        logger.warning(
            "%s: messages without a finite position of %s are left out", topic, ", ".join(names)
        )
        stamp, position = stamp[whole], position[whole]
    longest = LONGEST_GAP * float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
    effort = joints.effort[whole][:, columns]
    effort[:, list(model.followers)] = 0.0
    efforts = measured_efforts(stamp, effort, model, longest, topic)
    if not model.floating and not efforts.any_row:
        raise DataError(
            f"{topic} has no effort of any joint of {model.source}, whose base is fixed; let the "
            "driver fill JointState.effort"
        )
    return _Channel(joints.topic, stamp, np.hstack([position, efforts.values])), efforts


def joint_columns(names: Sequence[str], model: RobotModel, source: str) -> IntArray:
    """Return where in ``names`` each of the model's joints stands; ``source`` is for messages.

    A joint that follows another stands where its leader does, whether it is named or not.

    Raises
    ------
    ModelError
        When the model has a joint that is not among them.
    """
    missing = [name for name in model.measured_joint_names if name not in names]
    if missing:
        raise ModelError(
            f"{source} has no joint {', '.join(map(repr, missing))} of model {model.source}; it "
            f"has {', '.join(names)}; name every topic of joint states (`joint_topic`), "
            "or the model of this robot"
        )
    leaders = [
        index if joint.mimic is None else joint.mimic.leader
        for index, joint in enumerate(model.joints)
    ]
    places = [list(names).index(model.joint_names[leader]) for leader in leaders]
    return np.array(places, dtype=np.int64)


def _imu_channel(imu: ImuStream) -> _Channel:
    values = np.concatenate([imu.angular_velocity, imu.linear_acceleration], axis=1)
    return _Channel(imu.topic, imu.stamp, values)


def _wrench_channel(wrench: WrenchStream) -> _Channel:
    return _Channel(
        wrench.topic, wrench.stamp, np.concatenate([wrench.torque, wrench.force], axis=1)
    )


@contextmanager
def warned_once(*, muted: bool = False) -> Iterator[None]:
    """Let alignment warn once, or not at all, of what it would say of every slice of a log."""
    said: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        is_first = message not in said
        said.add(message)
        return is_first and not muted

    # A filter on a logger does not see its children's records.
    loggers = [logger, logging.getLogger(measured_efforts.__module__)]
    for each in loggers:
        each.addFilter(is_new)
    try:
        yield
    finally:
        for each in loggers:
            each.removeFilter(is_new)
