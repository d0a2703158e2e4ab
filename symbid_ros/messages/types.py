"""The message types of a robot log: their layouts, and functions that fill them from arrays.

Each ``fill_*`` function writes the columns of N records at once. Vectors are (N, 3), joint arrays
(N, J) and stamps (N,) integer nanoseconds. For one record all may lack the first axis: the
real-time path updates one record in place.
"""

import struct
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.messages.layout import (
    ENCAPSULATION,
    NUMBERS,
    Columns,
    Layout,
    Records,
    typestore,
)

JOINT_STATE = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"
WRENCH = "geometry_msgs/msg/WrenchStamped"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
ACCEL = "geometry_msgs/msg/AccelStamped"
CLOCK = "rosgraph_msgs/msg/Clock"
BOOL = "std_msgs/msg/Bool"

NANO = 1_000_000_000

HEADER = (Nodetype.NAME, "std_msgs/msg/Header")
TIME = (Nodetype.NAME, "builtin_interfaces/msg/Time")
_STAMP = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}


def joint_state_layout(names: tuple[str, ...], *, has_motion: bool = True) -> Layout:
    """Return the layout of a JointState; without motion, of one with efforts alone."""
    zeros = np.zeros(len(names))
    motion = zeros if has_motion else zeros[:0]
    return message_layout(
        JOINT_STATE, name=list(names), position=motion, velocity=motion, effort=zeros
    )


def imu_layout(frame_id: str) -> Layout:
    """Return the layout of an Imu: orientation of the IMU in the world, rad/s, specific force.

    Its covariances are zero, which means unknown (REP-145).
    """
    return message_layout(IMU, header=_header(frame_id))


def wrench_layout(frame_id: str) -> Layout:
    """Return the layout of a WrenchStamped: wrench of the environment on the robot."""
    return message_layout(WRENCH, header=_header(frame_id))


def trajectory_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a JointTrajectory with one point."""
    arrays = ("positions", "velocities", "accelerations", "effort")
    point = _zero_message(
        "trajectory_msgs/msg/JointTrajectoryPoint", **dict.fromkeys(arrays, np.zeros(len(names)))
    )
    return message_layout(TRAJECTORY, joint_names=list(names), points=[point])


def trajectory_message(names: tuple[str, ...], time: IntArray, motion: FloatArray) -> bytes:
    """Return a serialised JointTrajectory with N points.

    Parameters
    ----------
    names : tuple of str
        The D joints.
    time : (N,) int64
        Time of each point from the start, ns.
    motion : (3, N, D) float64
        Position, velocity and acceleration.
    """
    kind = "trajectory_msgs/msg/JointTrajectoryPoint"
    points = [
        _zero_message(
            kind,
            positions=position,
            velocities=velocity,
            accelerations=acceleration,
            time_from_start=typestore().types["builtin_interfaces/msg/Duration"](
                *divmod(stamp, NANO)
            ),
        )
        for stamp, position, velocity, acceleration in zip(time.tolist(), *motion, strict=True)
    ]
    message = _zero_message(TRAJECTORY, joint_names=list(names), points=points)
    return bytes(typestore().serialize_cdr(message, TRAJECTORY, little_endian=True))


def odometry_layout(frame_id: str, child_frame_id: str) -> Layout:
    """Return the layout of an Odometry: pose in ``frame_id``, twist in the child frame."""
    return message_layout(ODOMETRY, header=_header(frame_id), child_frame_id=child_frame_id)


def pose_layout(frame_id: str) -> Layout:
    """Return the layout of a PoseStamped, a pose in ``frame_id``."""
    return message_layout(POSE, header=_header(frame_id))


def accel_layout(frame_id: str) -> Layout:
    """Return the layout of an AccelStamped, expressed in ``frame_id``."""
    return message_layout(ACCEL, header=_header(frame_id))


def clock_layout() -> Layout:
    """Return the layout of a Clock."""
    return message_layout(CLOCK)


def message_layout(msgtype: str, **fields: Any) -> Layout:
    """Return the layout of a message with the given fields; all others are zero or empty."""
    return Layout.of(_zero_message(msgtype, **fields), msgtype)


def _header(frame_id: str) -> Any:
    return _zero_message("std_msgs/msg/Header", frame_id=frame_id)


def _zero_message(msgtype: str, **fields: Any) -> Any:
    """Return a message object of rosbags with the given fields; all others are zero or empty."""
    zeros = {name: _zero(*kind) for name, kind in typestore().fielddefs[msgtype][1]}
    return typestore().types[msgtype](**(zeros | fields))


def _zero(node: Nodetype, detail: Any) -> Any:
    if node == Nodetype.NAME:
        return _zero_message(detail)
    if node == Nodetype.BASE:
        return "" if detail[0] == "string" else 0
    (inner, kind), count = detail
    if inner == Nodetype.BASE and kind[0] in NUMBERS:
        return np.zeros(count, dtype=NUMBERS[kind[0]])
    return [_zero(inner, kind)] * count


def fill_stamp(columns: Columns, stamp: IntArray | int, path: str = "header.stamp") -> None:
    """Write stamps, given in nanoseconds."""
    columns[f"{path}.sec"][...], columns[f"{path}.nanosec"][...] = divmod(stamp, NANO)


def read_stamp(records: Records, path: str = "header.stamp") -> IntArray:
    """Return (N,) stamps, int64 nanoseconds."""
    seconds: IntArray = records[f"{path}.sec"].astype(np.int64)
    return seconds * NANO + records[f"{path}.nanosec"].astype(np.int64)


def fill_message(columns: Columns, stamp: IntArray | int, **fields: FloatArray) -> None:
    """Write the stamps and some fields, named by their paths in the layout.

    Joints are in the order of the layout, an orientation is xyzw.
    """
    fill_stamp(columns, stamp)
    for path, values in fields.items():
        columns[path][...] = values


def fill_wrench(columns: Columns, stamp: IntArray | int, wrench: FloatArray) -> None:
    """Write wrenches (N, 6): force, then torque about the origin of the frame."""
    fill_stamp(columns, stamp)
    columns["wrench.force"][...] = wrench[..., :3]
    columns["wrench.torque"][...] = wrench[..., 3:]


def has_stamp(msgtype: str) -> bool:
    """Return whether messages of a type begin with a header or a time."""
    fields = typestore().fielddefs[msgtype][1]
    return bool(fields) and fields[0][1] in (HEADER, TIME)


def read_leading_stamp(payload: bytes) -> int:
    """Return the stamp at the beginning of a serialised message, nanoseconds."""
    seconds, nanoseconds = _STAMP[payload[1] & 1].unpack_from(payload, ENCAPSULATION)
    return int(seconds) * NANO + int(nanoseconds)
