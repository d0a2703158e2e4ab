"""A log: the sensor measurements of one robot, read slice by slice as often as needed."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from symbid_ros.arrays import FloatArray, IntArray, distinct
from symbid_ros.errors import DataError
from symbid_ros.model.fixed_frames import FixedTransform, with_fixed_frames
from symbid_ros.model.load import as_model
from symbid_ros.model.tree import ON_LINK, RobotModel
from symbid_ros.signals.alignment import resampling_margin
from symbid_ros.signals.base_pose import PoseStream
from symbid_ros.signals.defects import (
    CLOCK_JUMP,
    Defect,
    DefectCounts,
    drop_impossible,
    kept_in_order,
    seconds,
)
from symbid_ros.signals.driving import driving_intervals
from symbid_ros.signals.given_arrays import flag_array, instants, number_array
from symbid_ros.signals.spikes import without_spikes
from symbid_ros.signals.streams import (
    WHOLE_LOG,
    ContactFlags,
    ImuStream,
    JointStream,
    Slice,
    Streams,
    TimeRange,
    WrenchStream,
)
from symbid_ros.signals.wrapped_angles import AngleUnwrapper

WORLD = "world"
# ns; no robot is read more than 20 000 times a second, and none can be identified from so few
# readings that steps are longer: milliseconds of 1 kHz, taken for seconds, have steps of 1 s.
LEAST_STEP, LONGEST_STEP = 50_000.0, 500_000_000.0
SliceReader = Callable[[int | None, bool], Iterator[Slice]]


@dataclass(frozen=True)
class Log:
    """Sensor measurements of one robot: one or several bags, or arrays.

    Get one from :func:`symbid_ros.load_bag` or :meth:`from_arrays`. A bag is read when its data are
    needed.

    Attributes
    ----------
    source : str
        Name for messages, such as the path of the bag.
    files : tuple of Path
        Bags that it is read from; empty for arrays.
    """

    source: str
    files: tuple[Path, ...] = ()
    _read: SliceReader = field(repr=False, kw_only=True)
    _open: "Callable[[tuple[Path, ...]], Log] | None" = field(
        default=None, repr=False, kw_only=True
    )
    _frames: Callable[[], tuple[FixedTransform, ...]] = field(
        default=tuple, repr=False, kw_only=True
    )
    _of_robot: "Callable[[RobotModel], Log] | None" = field(default=None, repr=False, kw_only=True)

    def of_robot(self, robot: RobotModel) -> "Log":
        """Return the log as one of this robot: the joints that it lacks are held.

        The log itself if it was read for a robot already, or has arrays.
        """
        return self if self._of_robot is None else self._of_robot(robot)

    def applied_to(self, robot: RobotModel) -> RobotModel:
        """Return a robot with the frames that the log says are fixed to its links."""
        return with_fixed_frames(robot, self.fixed_frames())

    def fixed_frames(self) -> tuple[FixedTransform, ...]:
        """Return the transforms between frames that the log says are fixed to each other."""
        return self._frames()

    def slices(self, span: int | None = None, *, warn: bool = True) -> Iterator[Slice]:
        """Yield the measurements in slices that end at multiples of ``span``.

        Parameters
        ----------
        span : int, optional
            Length of a slice, ns; slices of logs with high rates may be shorter. By default one
            slice holds everything.
        warn : bool
            Whether to log a warning about repaired messages at the end.

        Raises
        ------
        BagError, DataError
            When a bag or its content is invalid.
        """
        return self._read(span, warn)

    def other(self, bags: tuple[Path, ...]) -> "Log":
        """Return the log of other bags, read from the same topics.

        Raises
        ------
        BagError
            When a bag is missing or damaged; its messages are read later.
        DataError
            When this is a log of arrays, which have no topics.
        """
        if self._open is None:
            raise DataError(
                f"{', '.join(map(str, bags))}: its topics are unknown: {self.source} is a log "
                "of arrays; read the bag with load_bag and pass that log",
                "E526",
            )
        return self._open(bags)

    def streams(self) -> Streams:
        """Return all measurements at once.

        Raises
        ------
        BagError, DataError
            When a bag or its content is invalid, or a topic has no message.
        """
        (complete,) = self.slices()
        if complete.streams is None:
            raise DataError(complete.fault, "E520")
        return complete.streams

    @classmethod
    def from_arrays(
        cls,
        robot: RobotModel | str | Path,
        *,
        time: ArrayLike,
        position: ArrayLike,
        effort: ArrayLike,
        velocity: ArrayLike | None = None,
        imus: Mapping[str, ArrayLike] | None = None,
        wrenches: Mapping[str, ArrayLike] | None = None,
        poses: Mapping[str, ArrayLike] | None = None,
        touches: Mapping[str, ArrayLike] | None = None,
        driving: ArrayLike | None = None,
        start: float = 0.0,
        stop: float = np.inf,
        name: str = "arrays",
    ) -> "Log":
        """Return a log of arrays whose N rows were measured at the same instants.

        Parameters
        ----------
        robot : RobotModel, str or Path
            A robot or its file, whose joints and frames give the columns and the keys below.
        time : (N,) array_like
            Increasing instants: seconds if floating-point, nanoseconds if integer, or dates of
            Python, NumPy or pandas. Single precision holds seconds from the start of a log, but
            not those since 1970.
        position, effort : (N, J) array_like
            rad and Nm (m and N for prismatic joints), one column for each of
            ``robot.measured_joint_names``; a pandas table has columns of these names in any order.
            NaN or a mask marks a missing reading. Efforts are interpolated across five missing
            rows at most. Angles wrapped to one turn are unwrapped.
        velocity : (N, J) array_like, optional
            rad/s or m/s; only :func:`symbid_ros.diagnose` uses it, to check the positions.
        imus : mapping of str to (N, 6) array_like, optional
            For each frame: angular velocity (rad/s), then specific force (acceleration minus
            gravity, m/s²), in the axes of the frame.
        wrenches : mapping of str to (N, 6) array_like, optional
            For each frame: force (N), then torque (Nm) about its origin, exerted by the environment
            on the robot, in the axes of the frame. With a pose, the key ``world`` means world axes
            and the world's origin, as of a force plate; ``world@LINK`` names the link on it.
        poses : mapping of str to (N, 7) array_like, optional
            For a frame of a floating robot: its position in the world (m), z upwards, then its
            orientation as quaternion xyzw. It takes the place of an IMU. Beside one it tells the
            geometry, if that is estimated (``link_length``).
        touches : mapping of str to (N,) array_like of bool, optional
            Whether a contact named by ``contact`` touches anything, by its frame. Contacts without
            flags may touch something at any time.
        driving : (N,) array_like of bool, optional
            Whether a wheeled base drives. These times are left out, because the base counts as
            fixed.
        start, stop : float
            Part of the log to use, seconds after the first instant.
        name : str
            Name for messages.

        Raises
        ------
        DataError
            When an array has the wrong shape, a table lacks the column of a joint, or times are
            not in the stated unit and order.
        ModelError
            When the robot has no frame of that name.
        """
        robot, stamp = as_model(robot), _stamps(time, name)
        tallies = [DefectCounts(name, "time")]
        tallies[0].count_messages(stamp)
        kept = kept_in_order(stamp, tallies[0])
        names = robot.measured_joint_names
        unknown = np.full((len(stamp), len(names)), np.nan)

        def rows(what: str, values: ArrayLike, width: int = 0) -> FloatArray:
            array = number_array(f"{name}: {what}", values, () if width else names)
            shape = len(stamp), width or len(names)
            if array.shape != shape:
                raise DataError(
                    f"{name}: {what} has shape {array.shape}, expected {shape}: a row for each "
                    f"instant, and a column for each {'component' if width else 'joint'}",
                    "E511",
                )
            return drop_impossible(array[kept])

        def sensors(
            kind: str, given: Mapping[str, ArrayLike] | None
        ) -> Iterator[tuple[str, str, IntArray, FloatArray]]:
            """Yield topic, frame, stamps and rows; rows with NaN are counted, as for bags."""
            for frame, values in _by_frame(f"{name}: {kind}", given).items():
                place, _, link = frame.partition(ON_LINK)
                if poses and place == WORLD:
                    robot.frame(link or robot.link_names[0])
                else:
                    robot.frame(frame)
                topic = f"{kind}[{frame!r}]"
                read = rows(topic, values, 7 if kind == "poses" else 6)
                usable = np.isfinite(read).all(axis=1)
                tally = DefectCounts(name, topic)
                tally.count_messages(stamp[kept])
                tally.add(Defect.NOT_FINITE, stamp[kept], np.asarray(~usable), ["value"])
                tallies.append(tally)
                yield topic, frame, stamp[kept][usable], read[usable]

        recorded = JointStream(
            topic="joints",
            names=names,
            stamp=stamp[kept],
            position=rows("position", position),
            velocity=rows("velocity", unknown if velocity is None else velocity),
            effort=rows("effort", effort),
        )
        unwrapper = AngleUnwrapper(robot.prismatic_joint_names)
        tallies.append(DefectCounts(name, recorded.topic))
        tallies[-1].count_messages(recorded.stamp)
        joints = without_spikes(unwrapper.unwrapped(recorded), tallies[-1])
        unwrapper.report(name, joints.topic)
        imu_streams = tuple(
            ImuStream(
                topic=topic,
                frame_id=frame,
                stamp=at,
                orientation=None,
                angular_velocity=read[:, :3],
                linear_acceleration=read[:, 3:],
            )
            for topic, frame, at, read in sensors("imus", imus)
        )
        measured = [
            WrenchStream(topic, frame, at, force=read[:, :3], torque=read[:, 3:])
            for topic, frame, at, read in sensors("wrenches", wrenches)
        ]
        counts = {tally.topic: tally for tally in tallies}
        wrench_streams = tuple(without_spikes(one, counts[one.topic]) for one in measured)
        stamps = {one.topic: one.stamp for one in measured} | {recorded.topic: recorded.stamp}
        tracked = tuple(
            PoseStream(topic, frame, WORLD, at, read[:, :3], read[:, 3:])
            for topic, frame, at, read in sensors("poses", poses)
        )
        imu_streams = imu_streams or tuple(pose.imu() for pose in tracked)
        for pose in tracked:
            wrench_streams = tuple(
                pose.on_robot(one, one.frame_id.partition(ON_LINK)[2])
                if one.frame_id.partition(ON_LINK)[0] == WORLD
                else one
                for one in wrench_streams
            )
        flags = []
        for frame, values in _by_frame(f"{name}: touches", touches).items():
            robot.frame(frame)
            topic = f"touches[{frame!r}]"
            read = flag_array(f"{name}: {topic}", values)
            flags.append(
                ContactFlags(topic, frame, stamp[kept], rows(topic, read, 1)[:, 0].astype(bool))
            )
        drives = np.zeros(len(stamp)) if driving is None else driving
        read = rows("driving", flag_array(f"{name}: driving", drives), 1)
        moves = driving_intervals(stamp[kept], read[:, 0].astype(bool))
        streams = Streams(
            name,
            joints,
            imu_streams,
            wrench_streams,
            flags=tuple(flags),
            driving=moves,
            poses=tracked,
            is_arrays=True,
        )
        return cls.from_streams(streams, TimeRange(start, stop), tuple(tallies), stamps)

    @classmethod
    def from_streams(
        cls,
        streams: Streams,
        part: TimeRange = WHOLE_LOG,
        tallies: tuple[DefectCounts, ...] = (),
        recorded: Mapping[str, IntArray] | None = None,
    ) -> "Log":
        """Return a log of streams in memory, each with strictly increasing stamps.

        ``recorded`` gives the stamps (N,) ns of topics from which messages were dropped.
        """
        stamps = {one.topic: one.stamp for one in streams.all} | dict(recorded or {})

        read = partial(_slices, streams, part=part, tallies=tallies, stamps=stamps)
        return cls(streams.source, _read=read)


def require_log(log: object, *others: type) -> None:
    """Check that what a user gave is a log, or of another kind that a function takes.

    Raises
    ------
    DataError
        When it is not.
    """
    if not isinstance(log, (Log, *others)):
        names = " or a ".join(kind.__name__ for kind in (Log, *others))
        raise DataError(
            f"log must be a {names} (see symbid_ros.load_bag and symbid_ros.Log.from_arrays), not "
            f"{type(log).__name__}",
            "E511",
        )


def _by_frame(what: str, given: Mapping[str, ArrayLike] | None) -> Mapping[str, ArrayLike]:
    """Return the arrays of sensors by their frames, after checking that they are named."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise DataError(
            f"{what} is a {type(given).__name__}; give a mapping from frames to arrays", "E511"
        )
    return given


def _stamps(time: ArrayLike, name: str) -> IntArray:
    """Return instants (N,) as ns, after checking that their unit and order are possible."""
    stamp = instants(name, time)
    ordered = distinct(stamp)
    if len(ordered) == 1 < len(stamp):
        raise DataError(
            f"{name}: all times are {seconds(stamp[0])}; give the time of each row, in double "
            "precision: float32 rounds the time since 1970 to two minutes",
            "E315",
        )
    step = float(np.median(np.diff(ordered))) if len(ordered) > 1 else None
    if step is not None and not LEAST_STEP < step < LONGEST_STEP:
        shown = f"{step:g} ns" if step <= LEAST_STEP else seconds(round(step))
        raise DataError(
            f"{name}: the median step of time is {shown}, which no joint sensor's rate is; give "
            "seconds, or ns if they are integers",
            "E518",
        )
    change = np.diff(stamp)
    if len(jumps := np.flatnonzero(change < -CLOCK_JUMP)):
        at = jumps[0]
        raise DataError(
            f"{name}: time jumps back by {seconds(-change[at])} after {seconds(stamp[at])}, row "
            f"{at}; sort the rows of all arrays by time, or, if another run starts there, give "
            "each run as a log of its own (see symbid_ros.merge)",
            "E314",
        )
    return stamp


def _slices(
    streams: Streams,
    span: int | None,
    warn: bool,
    *,
    part: TimeRange,
    tallies: tuple[DefectCounts, ...],
    stamps: Mapping[str, IntArray],
) -> Iterator[Slice]:
    """Yield slices as `bags.slices` does for a bag, then report the defects."""
    stamp = streams.joints.stamp
    begin = int(stamp[0]) + round(1e9 * part.start)
    end = int(stamp[0]) + round(1e9 * part.stop) if np.isfinite(part.stop) else int(stamp[-1]) + 1
    until = begin
    margin = resampling_margin(each.stamp for each in streams.all)
    while (place := int(np.searchsorted(stamp, until))) < len(stamp) and stamp[place] < end:
        start = until
        until = end if span is None else min((int(stamp[place]) // span + 1) * span, end)
        inside = {
            topic: each[slice(*np.searchsorted(each, [start, until]))]
            for topic, each in stamps.items()
        }
        piece = streams.between(start - margin, until + margin)
        silent = [each.topic for each in piece.all if not len(each.stamp)]
        if silent:
            fault = (
                f"{streams.source}: {', '.join(silent)} has no data before {seconds(until)}; "
                "remove it, or use the same clock for all arrays"
            )
            yield Slice(start, until, None, inside, tallies, fault)
        else:
            yield Slice(start, until, piece, inside, tallies)
    for tally in tallies if warn else ():
        tally.report()
