"""Layouts against rosbags' serialiser, field by field and byte by byte."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rosbags.typesys import Stores, get_typestore

from symbid_ros.messages import types as messages
from symbid_ros.messages.layout import Layout, typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types

names = st.lists(
    st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9),
    min_size=1,
    max_size=7,
    unique=True,
).map(tuple)
frames = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def vector(width: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, width, elements=st.floats(width=64))


def time(stamp: int) -> object:
    return TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)


def header(stamp: int, frame: str) -> object:
    return TYPES["std_msgs/msg/Header"](stamp=time(stamp), frame_id=frame)


def xyz(values: np.ndarray, kind: str = "Vector3") -> object:
    fields = dict(zip("xyzw", map(float, values), strict=False))
    return TYPES[f"geometry_msgs/msg/{kind}"](**fields)


def encoded(layout: Layout, fill: object, stamp: int, **fields: np.ndarray) -> bytes:
    record = layout.records(1)
    fill(layout.columns(record), stamp, **fields)
    return record.tobytes()


@settings(max_examples=60, deadline=None)
@given(st.data(), names, stamps)
def test_joint_state_bytes_equal_rosbags(data: st.DataObject, joints: tuple, stamp: int) -> None:
    position, velocity, effort = (data.draw(vector(len(joints))) for _ in range(3))
    ours = encoded(
        messages.joint_state_layout(joints),
        messages.fill_message,
        stamp,
        position=position,
        velocity=velocity,
        effort=effort,
    )
    message = TYPES[messages.JOINT_STATE](
        header=header(stamp, ""),
        name=list(joints),
        position=position,
        velocity=velocity,
        effort=effort,
    )
    assert ours == STORE.serialize_cdr(message, messages.JOINT_STATE)


@settings(max_examples=60, deadline=None)
@given(frames, stamps, vector(4), vector(3), vector(3))
def test_imu_bytes_equal_rosbags(
    frame: str, stamp: int, orientation: np.ndarray, gyro: np.ndarray, accel: np.ndarray
) -> None:
    ours = encoded(
        messages.imu_layout(frame),
        messages.fill_message,
        stamp,
        orientation=orientation,
        angular_velocity=gyro,
        linear_acceleration=accel,
    )
    message = TYPES[messages.IMU](
        header=header(stamp, frame),
        orientation=xyz(orientation, "Quaternion"),
        orientation_covariance=np.zeros(9),
        angular_velocity=xyz(gyro),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=xyz(accel),
        linear_acceleration_covariance=np.zeros(9),
    )
    assert ours == STORE.serialize_cdr(message, messages.IMU)


@settings(max_examples=60, deadline=None)
@given(frames, stamps, vector(6))
def test_wrench_bytes_equal_rosbags(frame: str, stamp: int, wrench: np.ndarray) -> None:
    ours = encoded(messages.wrench_layout(frame), messages.fill_wrench, stamp, wrench=wrench)
    message = TYPES[messages.WRENCH](
        header=header(stamp, frame),
        wrench=TYPES["geometry_msgs/msg/Wrench"](force=xyz(wrench[:3]), torque=xyz(wrench[3:])),
    )
    assert ours == STORE.serialize_cdr(message, messages.WRENCH)


@settings(max_examples=60, deadline=None)
@given(st.data(), names, stamps)
def test_trajectory_bytes_equal_rosbags(data: st.DataObject, joints: tuple, stamp: int) -> None:
    position, velocity, acceleration, effort = (data.draw(vector(len(joints))) for _ in range(4))
    ours = encoded(
        messages.trajectory_layout(joints),
        messages.fill_message,
        stamp,
        **{
            "points.0.positions": position,
            "points.0.velocities": velocity,
            "points.0.accelerations": acceleration,
            "points.0.effort": effort,
        },
    )
    point = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"](
        positions=position,
        velocities=velocity,
        accelerations=acceleration,
        effort=effort,
        time_from_start=TYPES["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
    )
    message = TYPES[messages.TRAJECTORY](
        header=header(stamp, ""), joint_names=list(joints), points=[point]
    )
    assert ours == STORE.serialize_cdr(message, messages.TRAJECTORY)


@settings(max_examples=60, deadline=None)
@given(st.tuples(frames, frames), stamps, vector(7), vector(6))
def test_odometry_bytes_equal_rosbags(
    names: tuple[str, str], stamp: int, placement: np.ndarray, velocity: np.ndarray
) -> None:
    frame, child = names
    position, orientation = placement[:3], placement[3:]
    linear, angular = velocity[:3], velocity[3:]
    ours = encoded(
        messages.odometry_layout(frame, child),
        messages.fill_message,
        stamp,
        **{
            "pose.pose.position": position,
            "pose.pose.orientation": orientation,
            "twist.twist.linear": linear,
            "twist.twist.angular": angular,
        },
    )
    geometry = "geometry_msgs/msg/"
    pose = TYPES[geometry + "Pose"](
        position=xyz(position, "Point"), orientation=xyz(orientation, "Quaternion")
    )
    twist = TYPES[geometry + "Twist"](linear=xyz(linear), angular=xyz(angular))
    message = TYPES[messages.ODOMETRY](
        header=header(stamp, frame),
        child_frame_id=child,
        pose=TYPES[geometry + "PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=TYPES[geometry + "TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )
    assert ours == STORE.serialize_cdr(message, messages.ODOMETRY)


@settings(max_examples=60, deadline=None)
@given(frames, stamps, vector(3), vector(3))
def test_accel_bytes_equal_rosbags(
    frame: str, stamp: int, linear: np.ndarray, angular: np.ndarray
) -> None:
    fields = {"accel.linear": linear, "accel.angular": angular}
    ours = encoded(messages.accel_layout(frame), messages.fill_message, stamp, **fields)
    message = TYPES[messages.ACCEL](
        header=header(stamp, frame),
        accel=TYPES["geometry_msgs/msg/Accel"](linear=xyz(linear), angular=xyz(angular)),
    )
    assert ours == STORE.serialize_cdr(message, messages.ACCEL)


@given(stamps)
def test_clock_bytes_equal_rosbags(stamp: int) -> None:
    layout = messages.clock_layout()
    record = layout.records(1)
    messages.fill_stamp(layout.columns(record), stamp, "clock")
    message = TYPES[messages.CLOCK](clock=time(stamp))
    assert record.tobytes() == STORE.serialize_cdr(message, messages.CLOCK)


@pytest.mark.parametrize(
    "msgtype", [messages.JOINT_STATE, messages.IMU, messages.WRENCH, messages.ODOMETRY]
)
def test_type_hashes_are_those_of_the_installed_ros(msgtype: str) -> None:
    package, kind, name = msgtype.split("/")
    file = Path(sys.prefix) / "share" / package / kind / f"{name}.json"
    if not file.is_file():
        pytest.skip("the interface files of this ROS installation lie elsewhere")
    hashes = {
        entry["type_name"]: entry["hash_string"]
        for entry in json.loads(file.read_text())["type_hashes"]
    }
    assert STORE.hash_rihs01(msgtype) == hashes[msgtype]


def test_rclpy_decodes_a_record_filled_in_place() -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    payload = encoded(
        messages.joint_state_layout(("left_knee", "right_knee")),
        messages.fill_message,
        12_000_000_034,
        position=np.array([1.0, 2.0]),
        velocity=np.array([3.0, 4.0]),
        effort=np.array([5.0, 6.0]),
    )
    message = serialization.deserialize_message(payload, sensor_msgs.JointState)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 34)
    assert message.name == ["left_knee", "right_knee"]
    assert [*message.position, *message.velocity, *message.effort] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("text", ["", "a", "ab", "abc", "abcd", "a longer one"])
def test_layout_mismatches_for_each_byte_of_text_or_length_only(text) -> None:
    string = typestore().types["std_msgs/msg/String"](data=text)  # of no whole words, mostly
    for layout in (Layout.of(string, "std_msgs/msg/String"), messages.imu_layout(text)):
        size = len(layout.template)
        flipped = np.tile(np.frombuffer(layout.template, dtype=np.uint8), (size, 1))
        flipped[np.diag_indices(size)] ^= 0xFF
        np.testing.assert_array_equal(layout.matches(flipped), ~layout.constant)
