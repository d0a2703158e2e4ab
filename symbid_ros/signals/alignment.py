"""Alignment: streams with stamps of their own are resampled on one uniform clock.

The joint states give the clock. Streams sampled at its instants pass unchanged, others are
interpolated with cubic splines. Gaps are not interpolated: the log is cut into segments there.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, distinct
from symbid_ros.dynamics.unmeasured_contacts import touched_frame
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.ball_moments import with_moments_of_balls
from symbid_ros.signals.defects import typical_period
from symbid_ros.signals.efforts import MeasuredEfforts, measured_efforts
from symbid_ros.signals.end_stops import at_end_stops
from symbid_ros.signals.joint_clock import sampled_joints
from symbid_ros.signals.required_sensors import check_sensors, with_only_imu_frame
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.splines import interpolating_spline
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream

logger = logging.getLogger(__name__)

# A log is cut where a stream has no sample for longer than this many of its periods.
LONGEST_GAP = 5.5
SHORTEST_SEGMENT = 50

# What to do if each row of arrays holds the readings of one joint, as joined logs of drives do.
COMPLETE_ROWS = (
    "each row needs the readings of all joints at its time: interpolate each joint's readings to "
    "the times of one joint first (scipy.interpolate.CubicSpline)"
)

# Time, ns, by which a contact may open earlier or close later than its flag says: a Bool has no
# stamp. Treating a contact as closed is right at any time.
FLAG_MARGIN = 40_000_000
# Specific force, m/s², above which a robot is not in flight.
LARGEST_IN_FLIGHT = 5.0
FLIGHT_BLOCK = 0.1  # s over which it is averaged
# Margin beyond the ends of a slice, ns, that splines of slower topics need. The influence of a
# sample on a spline falls by a factor of four with each sample of distance.
MARGIN = 100_000_000
LONGEST_MARGIN = 1_000_000_000
SAMPLES_PER_MARGIN = 20


@dataclass(frozen=True)
class _Matrix:
    """One stream as a matrix: values (N, c) at ``stamp`` (N,); ``topic`` is for messages."""

    topic: str
    stamp: IntArray
    values: FloatArray

    @cached_property
    def period(self) -> float:
        """Typical time from one sample to the next, ns."""
        return typical_period(self.stamp)


def align(streams: Streams, model: RobotModel) -> tuple[Segment, ...]:
    """Resample all streams on the clock of the joint states.

    Raises
    ------
    DataError
        When the streams do not overlap or every segment is too short.
    ModelError
        When the log lacks joints of the model.
    """
    for stream in streams.all:
        if not len(stream.stamp):
            what = "message; check its driver, or leave the topic out"
            if streams.is_arrays:
                what = "row in the part that is used; correct its values, or leave it out"
            raise DataError(f"{streams.source}: {stream.topic} has no usable {what}", "E301")
    joints, efforts = _joint_channel(streams, model)
    channels = [joints, *map(_imu_channel, streams.imus), *map(_wrench_channel, streams.wrenches)]
    period = _period(joints, streams)
    start = max(int(channel.stamp[0]) for channel in channels)
    stop = min(int(channel.stamp[-1]) for channel in channels)
    if stop <= start:
        topics = ", ".join(channel.topic for channel in channels)
        kind = "arrays" if streams.is_arrays else "topics"
        raise DataError(
            f"{streams.source}: the {kind} {topics} have no time in common; check their clocks and "
            "stamps",
            "E302",
        )
    segments = tuple(
        _segment(channels, grid, period, streams, efforts=efforts, model=model)
        for grid in _grids(channels, start, stop, period, streams.driving)
    )
    if not segments and streams.driving:
        raise DataError(
            f"{streams.source}: the base drives all the time, or stands for less than "
            f"{SHORTEST_SEGMENT} joint states in a row; record the robot while its base is parked",
            "E367",
        )
    if not segments:
        action = "check the drivers for gaps" if streams.is_live else "record longer"
        where = "in every array" if streams.is_arrays else "on every topic"
        raise DataError(
            f"{streams.source}: there are no {SHORTEST_SEGMENT} samples in a row with data "
            f"{where}; {action}",
            "E303",
        )
    for segment in segments:
        _check_flight(segment, streams.source)
    return tuple(with_moments_of_balls(segment, model) for segment in segments)


def align_checked(streams: Streams, model: RobotModel) -> tuple[Segment, ...]:
    """Align streams after checking that they have the IMU and the frames that the model needs.

    Raises
    ------
    DataError
        When a floating robot has no IMU, or the log is too short.
    ModelError
        When a joint or a sensor's frame is not in the model.
    """
    # Frames of another robot's sensors are missing as well: its joints tell that it is another one.
    joint_columns(streams.joints.names, model, f"{streams.source}: {streams.joints.topic}")
    streams, warning = with_only_imu_frame(streams, model)
    if warning:
        logger.warning("%s: %s", streams.source, warning)
    check_sensors(streams, model)
    return align(streams, model)


def _touching(streams: Streams, grid: IntArray, model: RobotModel) -> BoolArray | None:
    """Return which contacts (M, C) may touch something at stamps (M,); None without flags."""
    if not streams.flags or model.contacts is None:
        return None
    flags = {touched_frame(model, one.frame_id): one.at(grid, FLAG_MARGIN) for one in streams.flags}
    always = np.ones(len(grid), dtype=bool)
    return np.stack([flags.get(frame, always) for frame in model.contacts.frames], axis=1)


def _check_flight(segment: Segment, source: str) -> None:
    """Check that a robot of which no contact touches anything falls freely.

    Flags with the opposite meaning would change the estimate without any other sign.
    """
    if segment.touching is None or segment.wrench_frames or not segment.imu_frames:
        return
    flight = ~segment.touching.any(axis=1)
    if np.count_nonzero(flight) < SHORTEST_SEGMENT:
        return
    # The second derivative of a pose is noisy, but its means over a tenth of a second are not.
    rows = segment.linear_acceleration[flight]
    size = min(len(rows), max(1, round(FLIGHT_BLOCK * segment.rate)))
    blocks = rows[: len(rows) // size * size].reshape(-1, size, *rows.shape[1:]).mean(axis=1)
    felt = float(np.median(np.linalg.norm(blocks, axis=2)))
    if felt > LARGEST_IN_FLIGHT:
        raise DataError(
            f"{source}: the flags say that no contact touches anything, but the IMU reads "
            f"{felt:.2g} m/s² then, as of a robot that something carries; correct the topics of "
            "`contact_flag`, or name all contacts in `contact`",
            "E368",
        )


def resampling_margin(topics: Iterable[IntArray]) -> int:
    """Return how far beyond the ends of a slice resampling needs data, ns.

    Parameters
    ----------
    topics : iterable of (N,) int64
        Stamps of each topic, ns.
    """
    steps = [np.diff(distinct(stamp)) for stamp in topics]
    periods = [float(np.median(each)) for each in steps if len(each)]
    needed = round(SAMPLES_PER_MARGIN * max(periods, default=0.0))
    return min(max(MARGIN, needed), LONGEST_MARGIN)


def _period(joints: _Matrix, streams: Streams) -> float:
    """Return the period of the joint states, ns."""
    if len(joints.stamp) < SHORTEST_SEGMENT:
        action = "publish at a higher rate" if streams.is_live else "record longer"
        raise DataError(
            f"{streams.source}: {joints.topic} has {len(joints.stamp)} "
            f"{'rows' if streams.is_arrays else 'joint states'}, at least "
            f"{SHORTEST_SEGMENT} are needed; {action}",
            "E303",
        )
    return joints.period


def _grids(
    channels: Sequence[_Matrix],
    start: int,
    stop: int,
    period: float,
    left_out: Sequence[tuple[int, int]],
) -> list[IntArray]:
    """Return the uniform stamps of each segment in which no stream has a gap.

    The times ``left_out``, ns, belong to no segment.
    """
    cuts = [
        (max(begin, start), min(end, stop))
        for begin, end in left_out
        if begin < stop and end > start
    ]
    for channel in channels:
        steps = np.diff(channel.stamp)
        longest = LONGEST_GAP * max(period, channel.period)
        late = np.flatnonzero(steps > longest)
        cuts += zip(channel.stamp[late].tolist(), channel.stamp[late + 1].tolist(), strict=True)
    edges = [start, *(edge for cut in _merged(cuts) for edge in cut), stop]
    grids = []
    ticks = channels[0].stamp
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        # Start at a joint state, so that a log with regular stamps needs no interpolation.
        first = np.searchsorted(ticks, begin)
        if first < len(ticks) and ticks[first] <= end:
            count = int((end - ticks[first]) / period + 1e-6) + 1
            if count >= SHORTEST_SEGMENT:
                grids.append(ticks[first] + np.rint(np.arange(count) * period).astype(np.int64))
    return grids


def _merged(cuts: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the union of intervals."""
    merged: list[tuple[int, int]] = []
    for begin, end in sorted(cuts):
        if merged and begin <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    return merged


def _segment(
    channels: Sequence[_Matrix],
    grid: IntArray,
    period: float,
    streams: Streams,
    *,
    efforts: MeasuredEfforts,
    model: RobotModel,
) -> Segment:
    joints = efforts.values.shape[1]
    position_and_effort, *others = (_resampled(channel, grid) for channel in channels)
    imus, wrenches = others[: len(streams.imus)], others[len(streams.imus) :]
    count = len(grid)
    readings = np.stack(imus, axis=1) if imus else np.zeros((count, 0, 6))
    effort = efforts.masked(grid, position_and_effort[:, joints:])
    contacts: dict[str, FloatArray] = {}
    rates = [1e9 / max(period, one.period) for one in channels[1:]]
    sensor_rates = rates[: len(imus)]
    unmeasured = () if model.contacts is None else model.contacts.frames
    for sensor, reading, rate in zip(streams.wrenches, wrenches, rates[len(imus) :], strict=True):
        if touched_frame(model, sensor.frame_id) in unmeasured:
            continue
        if (place := model.wrist_sensors.get(sensor.frame_id)) is None:
            contacts[sensor.topic] = reading
            sensor_rates.append(rate)
        else:
            # A joint's effort acts on what lies beyond it, a reading on what lies before.
            effort[:, place] = -reading
    position = position_and_effort[:, :joints]
    return Segment(
        stamp=grid,
        rate=1e9 / period,
        position=position,
        effort=effort,
        angular_velocity=readings[:, :, :3],
        linear_acceleration=readings[:, :, 3:],
        wrenches=np.stack([*contacts.values()], axis=1) if contacts else np.zeros((count, 0, 6)),
        imu_frames=tuple(imu.frame_id for imu in streams.imus),
        wrench_frames=tuple(one.frame_id for one in streams.wrenches if one.topic in contacts),
        touching=_touching(streams, grid, model),
        stopped=at_end_stops(position, model.joints) if model.end_stops else None,
        poses=np.stack([one.at(grid) for one in streams.poses], axis=1) if streams.poses else None,
        pose_frames=tuple(one.frame_id for one in streams.poses),
        sensor_rates=tuple(sensor_rates),
    )


def _resampled(channel: _Matrix, grid: IntArray) -> FloatArray:
    """Return the values (M, c) of a stream at the stamps of a grid (M,)."""
    first = int(np.searchsorted(channel.stamp, grid[0]))
    here = channel.stamp[first : first + len(grid)]
    if len(here) == len(grid) and np.array_equal(here, grid):
        return channel.values[first : first + len(grid)]
    low = max(0, int(np.searchsorted(channel.stamp, grid[0], side="right")) - 3)
    high = int(np.searchsorted(channel.stamp, grid[-1])) + 3
    stamp, values = channel.stamp[low:high], channel.values[low:high]
    seconds = (stamp - grid[0]) * 1e-9
    resampled: FloatArray = interpolating_spline(seconds, values)((grid - grid[0]) * 1e-9)
    return resampled


def _joint_channel(streams: Streams, model: RobotModel) -> tuple[_Matrix, MeasuredEfforts]:
    """Return positions and efforts of the model's joints, and which efforts were measured."""
    joints = sampled_joints(streams.joints).joints
    topic = f"{streams.source}: {joints.topic}"
    columns = joint_columns(joints.names, model, topic)
    stamp, position = joints.stamp, model.apply_mimics(joints.position[:, columns])
    is_finite = np.isfinite(position)
    is_complete = np.logical_and.reduce(is_finite, axis=1)
    if 0 < 2 * np.count_nonzero(~is_complete) >= len(is_complete):
        row, column = np.argwhere(~is_finite)[0]
        action = "let its driver publish it"
        if streams.is_arrays:
            action = COMPLETE_ROWS
        if not streams.is_live:
            action += ", leave out that part of the log (`start`, `stop`)"
        kind = "rows" if streams.is_arrays else "messages"
        raise DataError(
            f"{topic}: at least half of the {kind} have no finite position of a joint, such as "
            f"{model.joint_names[column]!r} at {stamp[row] * 1e-9:.3f} s; {action}, or give a "
            "model in which that joint is fixed",
            "E304",
        )
    if not is_complete.all():
        names = [model.joint_names[i] for i in np.flatnonzero(~is_finite.all(axis=0))]
        logger.warning(
            "%s: messages without a finite position of %s are dropped", topic, ", ".join(names)
        )
        stamp, position = stamp[is_complete], position[is_complete]
    longest = LONGEST_GAP * typical_period(stamp)
    effort = joints.effort[is_complete][:, columns]
    has_efforts = bool(np.any(np.isfinite(effort) & (effort != 0.0)))
    effort[:, list(model.followers)] = 0.0
    for place in model.wrist_sensors.values():
        effort[:, place] = 0.0  # their readings follow in each segment
    action = (
        "give efforts in Nm (N)" if streams.is_arrays else "let the driver fill JointState.effort"
    )
    efforts = measured_efforts(
        stamp,
        position,
        effort,
        model=model,
        longest_gap=longest,
        topic=topic,
        remedy=action,
        held=joints.held,
    )
    if not model.floating and not efforts.any_row:
        fault = "no effort of any joint"
        if not (streams.is_arrays or has_efforts):
            action += ", or name the topic that has the efforts as well (`joint_topic`)"
        if has_efforts:
            fault = f"gaps of more than {int(LONGEST_GAP)} efforts of every joint"
            action = COMPLETE_ROWS if streams.is_arrays else "let the driver publish all at once"
        raise DataError(
            f"{topic} has {fault} of {model.source}, whose base is fixed; {action}", "E305"
        )
    return _Matrix(joints.topic, stamp, np.hstack([position, efforts.values])), efforts


def joint_columns(names: Sequence[str], model: RobotModel, source: str) -> IntArray:
    """Return the index in ``names`` of each joint of the model; ``source`` is for messages.

    A mimic joint has the index of the joint that it follows, a wrist sensor's joint any index.

    Raises
    ------
    ModelError
        When ``names`` lacks a joint of the model.
    """
    missing = [name for name in model.measured_joint_names if name not in names]
    if missing:
        which = f"no joint {', '.join(map(repr, missing))}"
        if len(missing) == len(model.measured_joint_names) > 1:
            which = f"none of the joints {', '.join(map(repr, missing))}"
        raise ModelError(
            f"{source} has {which} of model {model.source}; it has "
            f"{', '.join(names)}; if these are other names of the same joints, `symbid init` "
            "finds them and writes a robot file; otherwise name every topic of joint "
            f"states (`joint_topic`), give `rename_joint` NAME:={missing[0]} or `hold_joint` "
            f"{missing[0]}:=POSITION, or the model of this robot",
            "E306",
        )
    leaders = [
        index if joint.mimic is None else joint.mimic.leader
        for index, joint in enumerate(model.joints)
    ]
    places = [
        0 if model.joints[leader].sensor else list(names).index(model.joint_names[leader])
        for leader in leaders
    ]
    return np.array(places, dtype=np.int64)


def _imu_channel(imu: ImuStream) -> _Matrix:
    values = np.concatenate([imu.angular_velocity, imu.linear_acceleration], axis=1)
    return _Matrix(imu.topic, imu.stamp, values)


def _wrench_channel(wrench: WrenchStream) -> _Matrix:
    return _Matrix(
        wrench.topic, wrench.stamp, np.concatenate([wrench.torque, wrench.force], axis=1)
    )


@contextmanager
def warn_once(*, muted: bool = False) -> Iterator[None]:
    """Log each warning of alignment once, or never, instead of once for each slice of a log."""
    logged: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        is_first = message not in logged
        logged.add(message)
        return is_first and not muted

    # The filter of a logger does not apply to records of its children.
    loggers = [logger, logging.getLogger(measured_efforts.__module__)]
    for each in loggers:
        each.addFilter(is_new)
    try:
        yield
    finally:
        for each in loggers:
            each.removeFilter(is_new)
