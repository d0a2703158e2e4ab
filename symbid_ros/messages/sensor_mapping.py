"""How a log's joints, frames and units relate to the robot model's."""

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import OptionError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.model.rotation import rotation_from_rpy
from symbid_ros.options import options_of, robot_file_line
from symbid_ros.signals.streams import ImuStream, JointStream, WrenchStream

logger = logging.getLogger(__name__)

T = TypeVar("T")
LARGEST = 1e9  # of a number in an entry; of factors also of their reciprocal
ASSIGN = ":="  # as in ROS remapping rules


@dataclass(frozen=True)
class SensorMapping:
    """Conversion of sensor readings to the names, units and signs of the robot model.

    Attributes
    ----------
    frame_prefix : str
        Prefix of the sensors' frames that the model's frames lack, such as ``robot1/``.
    frames, joints : mapping of str to str
        Names in the model by names in the log.
    flipped_joints : frozenset of str
        Joints whose positions and velocities have the opposite sign.
    flipped : frozenset of str
        Frames whose sensor measures the wrench of the robot on its environment.
    position_scale, effort_scale : mapping of str to float
        rad (m) and Nm (N) per recorded unit, by joint.
    held : mapping of str to float
        Constant positions of joints that are not recorded, rad (m).
    rotations : mapping of str to (3, 3) float64
        Axes of an IMU in its frame of the model, by frame.
    tracked : str
        Frame of the robot whose pose is measured; empty for an Odometry's own.
    plate_links : mapping of str to str
        Links that wrenches in axes of the world act on, by topic.
    flagged : mapping of str to str
        Frames of contacts, by the topics that tell whether they touch anything.
    of_robot : tuple of str
        As in `LogOptions`.
    """

    frame_prefix: str = ""
    frames: Mapping[str, str] = field(default_factory=dict)
    joints: Mapping[str, str] = field(default_factory=dict)
    flipped_joints: frozenset[str] = frozenset()
    flipped: frozenset[str] = frozenset()
    position_scale: Mapping[str, float] = field(default_factory=dict)
    effort_scale: Mapping[str, float] = field(default_factory=dict)
    held: Mapping[str, float] = field(default_factory=dict)
    rotations: Mapping[str, FloatArray] = field(default_factory=dict)
    tracked: str = ""
    plate_links: Mapping[str, str] = field(default_factory=dict)
    flagged: Mapping[str, str] = field(default_factory=dict)
    of_robot: tuple[str, ...] = ()

    @classmethod
    def of(cls, options: LogOptions) -> "SensorMapping":
        """Return the mapping that options describe.

        Raises
        ------
        OptionError
            When an entry is not of the form ``name:=value``, or a name is repeated.
        """
        return cls(
            options.frame_prefix,
            _pairs("rename_frame", options.rename_frame, str, may_be_empty=True),
            _pairs("rename_joint", options.rename_joint, str),
            frozenset(options.flip_joint),
            frozenset(options.flip_wrench),
            _pairs("position_scale", options.position_scale, _positive),
            _pairs("effort_scale", options.effort_scale, _factor),
            _pairs("hold_joint", options.hold_joint, _finite),
            _pairs("rotate_imu", options.rotate_imu, _rotation),
            options.pose_frame,
            _pairs("plate_link", options.plate_link, str),
            _pairs("contact_flag", options.contact_flag, str),
            options.of_robot,
        )

    def of_any_log(self) -> "SensorMapping":
        """Return the mapping as that of a robot, whose logs may lack some joints and frames."""
        return replace(self, of_robot=tuple(one.name for one in options_of(LogOptions)))

    def frame(self, frame_id: str) -> str:
        """Return the model's name of a sensor's frame."""
        name = frame_id.removeprefix(self.frame_prefix)
        return self.frames.get(frame_id, self.frames.get(name, name))

    def recorded_joints(self, names: Collection[str]) -> frozenset[str]:
        """Return the names that a log uses for joints of the model."""
        renamed = {model: recorded for recorded, model in self.joints.items()}
        return frozenset(renamed.get(name, name) for name in names if name not in self.held)

    def with_radians(self, stream: JointStream) -> JointStream:
        """Return joint states, named as in the log, with positions and velocities in rad (m)."""
        names = [self.joints.get(name, name) for name in stream.names]
        scale = np.array([self.position_scale.get(name, 1.0) for name in names])
        if (scale == 1.0).all():
            return stream
        return replace(stream, position=stream.position * scale, velocity=stream.velocity * scale)

    def converted_joints(self, stream: JointStream) -> JointStream:
        """Return joint states with the model's names and efforts in Nm (N)."""
        names = tuple(self.joints.get(name, name) for name in stream.names)
        scale = np.array([self.effort_scale.get(name, 1.0) for name in names])
        effort = stream.effort if (scale == 1.0).all() else stream.effort * scale
        if self.flipped_joints.intersection(names):
            sign = np.array([-1.0 if name in self.flipped_joints else 1.0 for name in names])
            stream = replace(
                stream, position=stream.position * sign, velocity=stream.velocity * sign
            )
        return replace(
            stream,
            names=names,
            effort=effort,
            effort_scale=self.effort_scale,
            position_scale=self.position_scale,
        )

    def converted_imu(self, stream: ImuStream) -> ImuStream:
        """Return readings in the axes of the model's frame."""
        frame = self.frame(stream.frame_id)
        rotation = self.rotations.get(frame)
        if rotation is None:
            return replace(stream, frame_id=frame)
        return replace(
            stream,
            frame_id=frame,
            orientation=None,  # of the sensor, not of the frame
            angular_velocity=stream.angular_velocity @ rotation.T,
            linear_acceleration=stream.linear_acceleration @ rotation.T,
        )

    def converted_wrench(self, stream: WrenchStream) -> WrenchStream:
        """Return readings as the wrench of the environment on the robot."""
        frame = self.frame(stream.frame_id)
        if frame not in self.flipped:
            return replace(stream, frame_id=frame)
        return replace(
            stream, frame_id=frame, force=-stream.force, torque=-stream.torque, is_flipped=True
        )


# Of a log with the model's names, units and signs.
SAME = SensorMapping()


@dataclass
class HeldJoints:
    """Joints of the model that a log lacks, at constant positions and without efforts.

    The first states decide which they are, so that a joint that is silent later is noticed. Only
    joints that the user names are held live, where others may be published later, and if the log
    has joints that the model lacks, which may be the missing ones under other names.

    Parameters
    ----------
    needed : tuple of str
        Joints of the model that are measured on a robot.
    positions : mapping of str to float
        Where the user holds joints, rad (m).
    is_live : bool
        Whether the states come from a running robot.
    logged : set of str
        Warnings that are not logged again.
    """

    needed: tuple[str, ...] = ()
    positions: Mapping[str, float] = field(default_factory=dict)
    is_live: bool = False
    logged: set[str] = field(default_factory=set)
    _held: dict[str, float] | None = None

    def added_to(self, stream: JointStream, source: str) -> JointStream:
        """Return joint states with a constant column for each joint that is held."""
        if self._held is None:
            self._held = self._missing(stream, source)
        held = {name: at for name, at in self._held.items() if name not in stream.names}
        if not held:
            return stream
        count = len(stream.stamp)

        def with_columns(values: FloatArray, constants: list[float]) -> FloatArray:
            return np.hstack([values, np.tile(constants, (count, 1))])

        nothing = [np.nan] * len(held)
        return replace(
            stream,
            names=(*stream.names, *held),
            position=with_columns(stream.position, list(held.values())),
            velocity=with_columns(stream.velocity, nothing),
            effort=with_columns(stream.effort, nothing),
            held=tuple(held),
        )

    @property
    def held(self) -> frozenset[str] | None:
        """Names of the joints that are held; None before the first states."""
        return None if self._held is None else frozenset(self._held)

    def _missing(self, stream: JointStream, source: str) -> dict[str, float]:
        missing = [name for name in self.needed if name not in stream.names]
        unnamed = [name for name in missing if name not in self.positions]
        # The log may be of another robot, or use other names.
        is_foreign = len(missing) == len(self.needed) or not set(stream.names) <= set(self.needed)
        if self.is_live or is_foreign:
            return {name: self.positions[name] for name in missing if name in self.positions}
        if unnamed:
            self._warn(
                f"{source}: {stream.topic} has no joint {', '.join(unnamed)}, held at 0; give the "
                f"position by `hold_joint` {unnamed[0]}:=POSITION, or its name in the log by "
                f"`rename_joint` NAME:={unnamed[0]}, or write "
                + robot_file_line("hold_joint", *(f"{name}:=0.0" for name in unnamed))
            )
        return {name: self.positions.get(name, 0.0) for name in missing}

    def _warn(self, message: str) -> None:
        if message not in self.logged:
            self.logged.add(message)
            logger.warning("%s", message)


def _pairs(
    option: str,
    entries: tuple[str, ...],
    read: Callable[[str], T | None],
    *,
    may_be_empty: bool = False,
) -> dict[str, T]:
    """Return entries ``name:=value`` as a dictionary; frames of messages may have no name."""
    found: dict[str, T] = {}
    for entry in entries:
        name, _, text = entry.partition(ASSIGN)
        value = read(text) if (name or may_be_empty) and text else None
        if value is None or name in found:
            reason = "repeats a name" if name in found else "is not valid"
            raise OptionError(f"`{option}`: {entry!r} {reason}; give {EXAMPLES[option]}", "E501")
        found[name] = value
    return found


EXAMPLES = {
    "rename_frame": "NAME_IN_LOG:=NAME_IN_MODEL, such as imu_sensor:=imu_link",
    "rename_joint": "NAME_IN_LOG:=NAME_IN_MODEL, such as j1:=shoulder_pan_joint",
    "position_scale": "JOINT:=FACTOR above zero, such as elbow_joint:=0.0174533 for degrees",
    "effort_scale": "JOINT:=FACTOR, such as elbow_joint:=-0.11",
    "hold_joint": "JOINT:=POSITION, such as wrist_joint:=0.5",
    "plate_link": "TOPIC:=LINK, such as /plate_1/wrench:=left_foot",
    "contact_flag": "TOPIC:=FRAME, such as /left_foot/contact:=left_sole",
    "rotate_imu": "FRAME:=ROLL,PITCH,YAW in degrees, such as imu_link:=180,0,90",
}


def _finite(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if abs(number) <= LARGEST else None  # refuses NaN


def _positive(text: str) -> float | None:
    """Return a factor that leaves the sign, which is for `flip_joint`."""
    value = _factor(text)
    return value if value is not None and value > 0 else None


def _factor(text: str) -> float | None:
    factor = _finite(text)
    # Zero would remove the efforts.
    return factor if factor is not None and abs(factor) >= 1 / LARGEST else None


def _rotation(text: str) -> FloatArray | None:
    """Return the rotation matrix of roll, pitch and yaw in degrees, about fixed axes as in URDF."""
    angles = [_finite(part) for part in text.split(",")]
    known = [angle for angle in angles if angle is not None]
    return rotation_from_rpy(np.radians(known)) if len(known) == len(angles) == 3 else None
