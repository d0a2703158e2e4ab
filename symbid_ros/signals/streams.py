"""Sensor streams as recorded, before alignment: one array per field and topic."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays
from symbid_ros.errors import DataError
from symbid_ros.signals.defects import DefectCounts

if TYPE_CHECKING:
    from symbid_ros.signals.base_pose import PoseStream


@dataclass(frozen=True)
class JointStream:
    """Messages of one JointState topic.

    Attributes
    ----------
    topic : str
        Topic as recorded, for messages to the user.
    names : tuple of str
        Joints in the order of the columns.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    position, velocity, effort : (N, J) float64
        rad or m, rad/s or m/s, Nm or N; NaN where the message has no value.
    effort_scale, position_scale : mapping of str to float
        Factors by which the user's options have converted efforts and positions of joints.
    held : tuple of str
        Joints that were not recorded, at constant positions.
    """

    topic: str
    names: tuple[str, ...]
    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    effort_scale: Mapping[str, float] = field(default_factory=dict)
    position_scale: Mapping[str, float] = field(default_factory=dict)
    held: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImuStream:
    """Messages of one Imu topic.

    Attributes
    ----------
    topic, frame_id : str
        Topic, and header.frame_id: the axes of all vectors.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    orientation : (N, 4) float64 or None
        Quaternion xyzw of the IMU in the world; None if the driver marks it as absent (first
        covariance element -1).
    angular_velocity : (N, 3) float64
        rad/s.
    linear_acceleration : (N, 3) float64
        Specific force, the acceleration minus gravity, m/s² (REP-145).
    """

    topic: str
    frame_id: str
    stamp: IntArray
    orientation: FloatArray | None
    angular_velocity: FloatArray
    linear_acceleration: FloatArray


@dataclass(frozen=True)
class WrenchStream:
    """Messages of one WrenchStamped topic: the wrench of the environment on the robot.

    Attributes
    ----------
    topic, frame_id : str
        Topic, and header.frame_id: axes and origin of the wrench.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    force, torque : (N, 3) float64
        N and Nm; the torque is about the frame's origin.
    is_flipped : bool
        Whether the user's options have reversed its sign.
    """

    topic: str
    frame_id: str
    stamp: IntArray
    force: FloatArray
    torque: FloatArray
    is_flipped: bool = False


@dataclass(frozen=True)
class ContactFlags:
    """Tells when a contact without a wrench sensor touches something.

    Attributes
    ----------
    topic, frame_id : str
        Topic, and the contact's frame.
    stamp : (N,) int64
        Instants from which a flag holds, ns. Before the first, the contact may touch something.
    touches : (N,) bool
        The flags.
    """

    topic: str
    frame_id: str
    stamp: IntArray
    touches: BoolArray

    def at(self, stamp: IntArray, margin: int) -> BoolArray:
        """Return whether it touches at any time within a margin, ns, of stamps (M,)."""
        count = np.concatenate([[0], np.cumsum(self.touches)])
        first = np.searchsorted(self.stamp, stamp - margin, side="right") - 1
        last = np.searchsorted(self.stamp, stamp + margin, side="right")
        found: BoolArray = (first < 0) | (count[last] > count[np.maximum(first, 0)])
        return found


Stream = JointStream | ImuStream | WrenchStream
S = TypeVar("S", JointStream, ImuStream, WrenchStream)


@dataclass(frozen=True)
class Streams:
    """All sensor streams of one log or of live topics.

    Attributes
    ----------
    source : str
        Name of the log, for messages.
    joints : JointStream
    imus : tuple of ImuStream
    wrenches : tuple of WrenchStream
    is_live : bool
        Whether they come from a running robot; error messages then give no advice about bags.
    flags : tuple of ContactFlags
        Complete up to the end of the other streams.
    driving : tuple of (int, int)
        Times, ns, at which a wheeled base drives.
    poses : tuple of PoseStream
        Measured poses of a floating robot; they may have gaps.
    is_arrays : bool
        Whether they are arrays of a user; error messages then speak of these, not of topics.
    """

    source: str
    joints: JointStream
    imus: tuple[ImuStream, ...]
    wrenches: tuple[WrenchStream, ...]
    is_live: bool = False
    flags: tuple[ContactFlags, ...] = ()
    driving: tuple[tuple[int, int], ...] = ()
    poses: "tuple[PoseStream, ...]" = ()
    is_arrays: bool = False

    @property
    def all(self) -> tuple[Stream, ...]:
        """Joint states, then IMUs, then wrenches; all that have a value at every instant."""
        return (self.joints, *self.imus, *self.wrenches)

    def select(self, rows: Callable[[Stream], slice | BoolArray]) -> "Streams":
        """Return the streams with those messages that ``rows`` selects of each."""

        def selected(stream: S) -> S:
            chosen = rows(stream)
            return map_arrays(stream, lambda values: values[chosen])

        return replace(
            self,
            joints=selected(self.joints),
            imus=tuple(map(selected, self.imus)),
            wrenches=tuple(map(selected, self.wrenches)),
        )

    def without_wrenches(self, frames: Collection[str]) -> "Streams":
        """Return the streams without the wrench sensors at some frames."""
        return replace(
            self, wrenches=tuple(one for one in self.wrenches if one.frame_id not in frames)
        )

    def between(self, start: int, stop: int) -> "Streams":
        """Return the messages with stamps from ``start`` up to ``stop``, ns."""

        def inside(stream: "Stream | PoseStream") -> slice:
            return slice(*np.searchsorted(stream.stamp, [start, stop]))

        poses = tuple(map_arrays(one, itemgetter(inside(one))) for one in self.poses)
        return replace(self.select(inside), poses=poses)


@dataclass(frozen=True)
class TruthStreams:
    """The simulator's ``ground_truth/`` topics, which only validation reads.

    Attributes
    ----------
    source : str
        Name of the bag.
    joint_names : tuple of str
        Joints in the order of the columns.
    stamp : (N,) int64
        Nanoseconds, common to all arrays.
    position, velocity, acceleration, effort : (N, J) float64
        True joint motion and applied torques.
    base_position : (N, 3) float64
        Base origin in the world, m.
    base_orientation : (N, 4) float64
        Quaternion xyzw of the base in the world.
    base_linear_velocity, base_angular_velocity : (N, 3) float64
        Of the base origin relative to the world, in base axes.
    base_linear_acceleration : (N, 3) float64
        Second derivative of the base origin's world position, in base axes, without gravity.
    base_angular_acceleration : (N, 3) float64
        In base axes, rad/s².
    """

    source: str
    joint_names: tuple[str, ...]
    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    base_position: FloatArray
    base_orientation: FloatArray
    base_linear_velocity: FloatArray
    base_angular_velocity: FloatArray
    base_linear_acceleration: FloatArray
    base_angular_acceleration: FloatArray


@dataclass(frozen=True)
class TimeRange:
    """Part of a log, in seconds after its first joint state."""

    start: float = 0.0
    stop: float = np.inf

    def __post_init__(self) -> None:
        ends: tuple[Any, ...] = self.start, self.stop  # of a user
        if not all(isinstance(one, Real) for one in ends) or not 0 <= self.start < self.stop:
            start, stop = (f"{one:g} s" if isinstance(one, Real) else repr(one) for one in ends)
            raise DataError(
                f"start {start} and stop {stop} are invalid; give a start of at least 0 and a "
                "later stop, in seconds after the first joint state",
                "E316",
            )


@dataclass(frozen=True)
class Slice:
    """Slice of a log, the unit in which logs are read and processed.

    Attributes
    ----------
    start, stop : int
        First stamp and end, ns.
    streams : Streams or None
        Measurements of that time with a margin at both ends; None if a topic was silent.
    stamps : dict of str to (N,) int64
        Stamps of each topic in that time as recorded, ns.
    tallies : tuple of DefectCounts
        Defects of each topic so far; counting continues with the next slice.
    fault : str
        Which topic was silent; empty if none was.
    recording : int
        Number of the recording; between two, nothing is missing.
    split_stamps : dict of str to tuple of (N,) int64
        Of topics whose messages name different joints, the stamps for each set of joints.
    """

    start: int
    stop: int
    streams: Streams | None
    stamps: Mapping[str, IntArray]
    tallies: tuple[DefectCounts, ...]
    fault: str = ""
    recording: int = 0
    split_stamps: Mapping[str, tuple[IntArray, ...]] = field(default_factory=dict)


WHOLE_LOG = TimeRange()
