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
from symbid_ros.messages.layout import ENCAPSULATION, Columns, Layout, Records, typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"
WRENCH = "geometry_msgs/msg/WrenchStamped"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ODOMETRY = "nav_msgs/msg/Odometry"
ACCEL = "geometry_msgs/msg/AccelStamped"
CLOCK = "rosgraph_msgs/msg/Clock"

NANO = 1_000_000_000

HEADER = (Nodetype.NAME, "std_msgs/msg/Header")
TIME = (Nodetype.NAME, "builtin_interfaces/msg/Time")
_STAMP = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}


def _message(msgtype: str, **fields: Any) -> Any:
    return typestore().types[msgtype](**fields)


def _time() -> Any:
    return _message("builtin_interfaces/msg/Time", sec=0, nanosec=0)


def _header(frame_id: str) -> Any:
    return _message("std_msgs/msg/Header", stamp=_time(), frame_id=frame_id)


def _vector() -> Any:
    return _message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)


def _quaternion() -> Any:
    return _message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)


def joint_state_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a JointState with all four arrays filled."""
    zeros = np.zeros(len(names))
    message = _message(
        JOINT_STATE,
        header=_header(""),
        name=list(names),
        position=zeros,
        velocity=zeros,
        effort=zeros,
    )
    return Layout.of(message, JOINT_STATE)


def imu_layout(frame_id: str) -> Layout:
    """Return the layout of an Imu: orientation of the IMU in the world, rad/s, specific force.

    Zero covariances mean unknown (REP-145).
    """
    unknown = np.zeros(9)
    message = _message(
        IMU,
        header=_header(frame_id),
        orientation=_quaternion(),
        orientation_covariance=unknown,
        angular_velocity=_vector(),
        angular_velocity_covariance=unknown,
        linear_acceleration=_vector(),
        linear_acceleration_covariance=unknown,
    )
    return Layout.of(message, IMU)


def wrench_layout(frame_id: str) -> Layout:
    """Return the layout of a WrenchStamped: wrench of the environment on the robot."""
    wrench = _message("geometry_msgs/msg/Wrench", force=_vector(), torque=_vector())
    return Layout.of(_message(WRENCH, header=_header(frame_id), wrench=wrench), WRENCH)


def trajectory_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a JointTrajectory with one point."""
    zeros = np.zeros(len(names))
    point = _message(
        "trajectory_msgs/msg/JointTrajectoryPoint",
        positions=zeros,
        velocities=zeros,
        accelerations=zeros,
        effort=zeros,
        time_from_start=_message("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
    )
    message = _message(TRAJECTORY, header=_header(""), joint_names=list(names), points=[point])
    return Layout.of(message, TRAJECTORY)


def odometry_layout(frame_id: str, child_frame_id: str) -> Layout:
    """Return the layout of an Odometry: pose in ``frame_id``, twist in the child frame."""
    point = _message("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
    pose = _message("geometry_msgs/msg/Pose", position=point, orientation=_quaternion())
    twist = _message("geometry_msgs/msg/Twist", linear=_vector(), angular=_vector())
    message = _message(
        ODOMETRY,
        header=_header(frame_id),
        child_frame_id=child_frame_id,
        pose=_message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=_message(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
        ),
    )
    return Layout.of(message, ODOMETRY)


def accel_layout(frame_id: str) -> Layout:
    """Return the layout of an AccelStamped, expressed in ``frame_id``."""
    accel = _message("geometry_msgs/msg/Accel", linear=_vector(), angular=_vector())
    return Layout.of(_message(ACCEL, header=_header(frame_id), accel=accel), ACCEL)


def clock_layout() -> Layout:
    """Return the layout of a Clock."""
    return Layout.of(_message(CLOCK, clock=_time()), CLOCK)


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
