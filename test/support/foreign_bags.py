"""Messages and bags of another library: rosbags serialises and writes them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types

Messages = Sequence[tuple[str, str, bytes]]  # topic, type, payload


def header(stamp: int, frame: str = "") -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def vector(values: Sequence[float], kind: str = "Vector3") -> Any:
    return TYPES[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", values, strict=False)))


def joint_state(
    stamp: int,
    names: Sequence[str],
    position: Sequence[float] = (),
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
    *,
    little_endian: bool = True,
) -> bytes:
    message = TYPES[JOINT_STATE](
        header=header(stamp),
        name=list(names),
        position=np.array(position, dtype=float),
        velocity=np.array(velocity, dtype=float),
        effort=np.array(effort, dtype=float),
    )
    return bytes(STORE.serialize_cdr(message, JOINT_STATE, little_endian=little_endian))


def imu(
    stamp: int,
    gyro: Sequence[float] = (0.0, 0.0, 0.0),
    covariance: float = 0.0,
    frame: str = "imu_link",
) -> bytes:
    message = TYPES[IMU](
        header=header(stamp, frame),
        orientation=vector((0.0, 0.0, 0.0, 1.0), "Quaternion"),
        orientation_covariance=np.full(9, covariance),
        angular_velocity=vector(gyro),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector((0.0, 0.0, 9.81)),
        linear_acceleration_covariance=np.zeros(9),
    )
    return bytes(STORE.serialize_cdr(message, IMU))


def wrench(stamp: int, force: Sequence[float]) -> bytes:
    pair = TYPES["geometry_msgs/msg/Wrench"](force=vector(force), torque=vector((0.0, 0.0, 0.0)))
    message = TYPES[WRENCH](header=header(stamp, "left_sole"), wrench=pair)
    return bytes(STORE.serialize_cdr(message, WRENCH))


def write_rosbags(
    path: Path,
    messages: Messages,
    topics: Sequence[tuple[str, str]] = (),
    times: Sequence[int] = (),
) -> Path:
    """Write a bag with rosbags; ``times`` are those of writing, ns."""
    with RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        announced = dict.fromkeys([*topics, *((name, kind) for name, kind, _ in messages)])
        connections = {pair: writer.add_connection(*pair, typestore=STORE) for pair in announced}
        for index, (name, kind, payload) in enumerate(messages):
            writer.write(connections[name, kind], times[index] if times else index, payload)
    return path


def joints_only(path: Path, *payloads: bytes) -> Path:
    return write_rosbags(path, [("/joint_states", JOINT_STATE, payload) for payload in payloads])
