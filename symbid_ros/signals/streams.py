"""What sensors said, one array per field and topic, before anything is aligned."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.signals.defects import DefectCounts


@dataclass(frozen=True)
class JointStream:
    """Messages of one JointState topic.

    Attributes
    ----------
    topic : str
        Topic name as recorded, for messages to the user.
    names : tuple of str
        Joint names, the order of the columns below.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    position, velocity, effort : (N, J) float64
        rad or m, rad/s or m/s, Nm or N. NaN where the message has no value.
    """

    topic: str
    names: tuple[str, ...]
    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclass(frozen=True)
class ImuStream:
    """Messages of one Imu topic (REP-145: the acceleration is the specific force).

    Attributes
    ----------
    topic, frame_id : str
        Topic name and header.frame_id, the frame of all vectors below.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    orientation : (N, 4) float64 or None
        Quaternion xyzw of the IMU in the world; None when the field is absent
        (first covariance element -1).
    angular_velocity : (N, 3) float64
        rad/s.
    linear_acceleration : (N, 3) float64
        Specific force (acceleration minus gravity), m/s².
    """

    topic: str
    frame_id: str
    stamp: IntArray
    orientation: FloatArray | None
    angular_velocity: FloatArray
    linear_acceleration: FloatArray


@dataclass(frozen=True)
class WrenchStream:
    """Messages of one WrenchStamped topic: environment on robot.

    Attributes
    ----------
    topic, frame_id : str
        Topic name and header.frame_id: axes and origin of the wrench.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    force, torque : (N, 3) float64
        N and Nm, the torque about the frame's origin.
    """

    topic: str
    frame_id: str
    stamp: IntArray
    force: FloatArray
    torque: FloatArray


@dataclass(frozen=True)
class Streams:
    """All sensor streams of one recording or of live topics.

    Attributes
    ----------
    source : str
        Name of the bag, for messages.
    joints : JointStream
    imus : tuple of ImuStream
    wrenches : tuple of WrenchStream
    is_live : bool
        Whether they come from a running robot: advice about a bag would be of no use then.
    """

    source: str
    joints: JointStream
    imus: tuple[ImuStream, ...]
    wrenches: tuple[WrenchStream, ...]
    is_live: bool = False


@dataclass(frozen=True)
class TruthStreams:
    """The simulator's ``ground_truth/`` topics; validation alone may read them.

    Attributes
    ----------
    source : str
        The bag's name.
    joint_names : tuple of str
        Order of the joint columns.
    stamp : (N,) int64
        Nanoseconds, the same instant for every array.
    position, velocity, acceleration, effort : (N, J) float64
        True joint motion and true applied torques.
    base_position : (N, 3) float64
        Base origin in the world, m.
    base_orientation : (N, 4) float64
        Quaternion xyzw of the base in the world.
    base_linear_velocity, base_angular_velocity : (N, 3) float64
        Of the base origin relative to the world, in base axes.
    base_linear_acceleration : (N, 3) float64
        Second derivative of the base origin's world position, in base axes;
        gravity is not in it.
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
    """A part of a recording, in seconds after its first joint state."""

    start: float = 0.0
    stop: float = np.inf

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise DataError(
                f"from {self.start:g} s to {self.stop:g} s is no part of a recording; give a start "
                "from 0 on and a later stop, seconds after the first joint state"
            )


@dataclass(frozen=True)
class Slice:
    """A slice of a recording.

    Attributes
    ----------
    start, stop : int
        From where up to where, ns of header.stamp.
    streams : Streams or None
        Of that time, and of a margin at both ends; None where a topic was silent.
    stamps : dict of str to (N,) int64
        By topic the stamps of that time as they were recorded, ns.
    tallies : tuple of DefectCounts
        What was mended so far, one for each topic; they go on counting.
    fault : str
        Which was silent; empty where none was.
    """

    start: int
    stop: int
    streams: Streams | None
    stamps: Mapping[str, IntArray]
    tallies: tuple[DefectCounts, ...]
    fault: str = ""


ALL_OF_IT = TimeRange()
