"""Error messages for unusable bags."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from expected_errors import raises_code
from foreign_bags import STORE, Messages, imu, joint_state, joints_only, wrench, write_rosbags
from rosbags.rosbag2 import Writer as RosbagsWriter

from symbid_ros.bags import read_streams, read_truth
from symbid_ros.errors import BagError, DataError
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

NAN, INFINITE = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("messages", "line"),
    [
        (
            [
                ("/joint_states", JOINT_STATE, joint_state(1, ["hip"], [0.0])),
                ("/imu/data", IMU, imu(2 * 10**9, (0.0, NAN, 0.0))),
            ],
            "/imu/data: angular_velocity.y is nan at 2.000 s",
        ),
        (
            [
                ("/joint_states", JOINT_STATE, joint_state(1, ["hip"], [0.0])),
                ("/left_foot/wrench", WRENCH, wrench(0, (0.0, 0.0, -INFINITE))),
            ],
            "/left_foot/wrench: wrench.force.z is -inf at 0.000 s",
        ),
        (
            [
                ("/joint_states", JOINT_STATE, joint_state(1, ["hip"], [0.0])),
                ("/imu/data", IMU, imu(1)),
                ("/imu/data", IMU, imu(2, frame="torso")),
            ],
            "/imu/data: header.frame_id changes between imu_link, torso",
        ),
        (
            [("/joint_states", JOINT_STATE, joint_state(1, ["hip", "hip"], [0.0, 1.0]))],
            "/joint_states: a joint is named twice at 0.000 s",
        ),
        (
            [("/joint_states", JOINT_STATE, joint_state(1, []))],
            "/joint_states: no message names its joints",
        ),
        (
            [("/joint_states", JOINT_STATE, joint_state(0, ["hip"], [n])) for n in range(3)],
            "/joint_states: all header stamps are 0.000 s",
        ),
        (
            [
                ("/joint_states", JOINT_STATE, joint_state(5 * 10**9, ["hip"], [0.0])),
                ("/joint_states", JOINT_STATE, joint_state(10**9, ["hip"], [0.0])),
            ],
            "/joint_states: header stamps jump back by 4.000 s after 5.000 s",
        ),
        (
            [("/joint_states", JOINT_STATE, b"\0\1\0\0 too short")],
            "/joint_states: message 1 is not a valid sensor_msgs/msg/JointState",
        ),
    ],
)
def test_unusable_messages_raise_an_error_naming_the_value(
    tmp_path: Path, messages: Messages, line: str
) -> None:
    with pytest.raises(DataError) as caught:
        read_streams([write_rosbags(tmp_path / "log", messages)])
    assert str(caught.value).startswith(f"{tmp_path / 'log'}: {line}")
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


def test_a_few_invalid_messages_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = write_rosbags(
        tmp_path / "log",
        [
            *(
                ("/joint_states", JOINT_STATE, joint_state(n, ["a", "b"], [0.1 * n, 0.0]))
                for n in range(10)
            ),
            *(
                ("/imu/data", IMU, imu(n, (0.0, INFINITE if n > 6 else 0.0, 0.0)))
                for n in range(10)
            ),
        ],
    )
    streams = read_streams([bag])
    assert streams.imus[0].stamp.tolist() == [*range(7)]
    assert "3 of 10 messages have no usable angular_velocity.y" in caplog.text


def test_nan_of_a_joint_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """ros2_control's joint_state_broadcaster fills the interfaces that a joint lacks with NaN."""
    payloads = [
        joint_state(n, ["hip", "wheel"], [0.1 * n, NAN], [NAN, 1.0], [INFINITE, NAN])
        for n in range(1, 5)
    ]
    joints = read_streams([joints_only(tmp_path / "log", *payloads)]).joints
    assert joints.stamp.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(joints.position[0], [0.1, NAN])
    np.testing.assert_array_equal(joints.velocity[0], [NAN, 1.0])
    np.testing.assert_array_equal(joints.effort[0], [NAN, NAN])
    assert caplog.messages == []


def test_numbers_that_no_sensor_reads_are_left_out(tmp_path: Path, caplog) -> None:
    """A log of a real arm holds 1e305 rad in some rows that its recorder damaged."""
    damaged = 5
    payloads = [
        ("/joint_states", JOINT_STATE, joint_state(n, ["hip"], [1e305 if n == damaged else 0.1]))
        for n in range(10)
    ]
    readings = [
        ("/imu/data", IMU, imu(n, (0.0, -1e240 if n == damaged else 0.0, 0.0))) for n in range(10)
    ]
    streams = read_streams([write_rosbags(tmp_path / "log", [*payloads, *readings])])
    assert np.flatnonzero(np.isnan(streams.joints.position)).tolist() == [damaged]
    assert damaged not in streams.imus[0].stamp
    assert "1 of 10 messages have no usable angular_velocity.y" in caplog.text


def test_errors_for_missing_topics_list_the_existing_ones(tmp_path: Path) -> None:
    bag = write_rosbags(
        tmp_path / "log",
        [("/imu/data", IMU, imu(1))],
        topics=[("/robot/joint_states", JOINT_STATE)],
    )
    with raises_code("E213", "/robot/joint_states"):
        read_streams([bag])
    with raises_code("E210", r"legs, .* /imu/data \(sensor_msgs/msg/Imu"):
        read_streams([bag], TopicSelection(joints=("legs",)))
    with raises_code("E211", r"/imu/data .* sensor_msgs/msg/Imu, not sens"):
        read_streams([bag], TopicSelection(joints=("/imu/data",)))
    with raises_code("E223", r"ground_truth/joints, .* /imu/data"):
        read_truth([bag])
    only_imu = write_rosbags(tmp_path / "imu", [("/imu/data", IMU, imu(1))])
    with raises_code("E210", "sensor_msgs/msg/JointState"):
        read_streams([only_imu])


def damaged(log: Path, change: Callable[[bytearray], bytes]) -> Path:
    file = log / "log_0.mcap"
    file.write_bytes(change(bytearray(file.read_bytes())))
    return log


def with_flipped_byte(image: bytearray) -> bytes:
    image[len(image) // 3] ^= 0x10
    return bytes(image)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda image: bytes(image[: len(image) // 2]), "the recording was interrupted"),
        (lambda image: b"", "empty; record it again"),
        (lambda image: b"SQLite format 3\0" + bytes(100), "an SQLite file; rename it"),
        (lambda image: bytes(image[1:]), "not an MCAP file"),
        (lambda image: bytes(image[:8]), "the recording was interrupted"),
        (with_flipped_byte, "damaged MCAP file"),
        (lambda image: bytes(image[:4000] + image[-37:]), "damaged MCAP file"),
    ],
    ids=["cut", "empty", "sqlite", "shifted", "magic-only", "flipped", "hollow"],
)
def test_damaged_files_are_rejected(
    log: Path, change: Callable[[bytearray], bytes], line: str
) -> None:
    with pytest.raises(BagError) as caught:
        read_streams([damaged(log, change)])
    assert str(caught.value).startswith(f"{log / 'log_0.mcap'}: ")
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrong_message_index_is_ignored(robot, log: Path, tmp_path: Path) -> None:
    """Offsets are shifted in each message index, so the records are scanned instead."""

    def shift(image: bytearray) -> bytes:
        position = 8
        while position < len(image) - 45:
            opcode, length = struct.unpack_from("<BQ", image, position)
            if opcode == 7:
                for entry in range(position + 15, position + 9 + length, 16):
                    time, offset = struct.unpack_from("<QQ", image, entry)
                    struct.pack_into("<QQ", image, entry, time, offset + 1)
            position += 9 + length
        return bytes(image)

    effort = read_streams([damaged(log, shift)]).joints.effort
    assert np.array_equal(effort, robot.all("joint_effort"))


def test_missing_paths_are_named(log: Path, tmp_path: Path) -> None:
    with raises_code("E201", "nowhere: "):
        read_streams([tmp_path / "nowhere"])
    (tmp_path / "empty").mkdir()
    with raises_code("E201", "empty: "):
        read_streams([tmp_path / "empty"])
    with raises_code("E202"):
        read_streams([])
    (log / "log_0.mcap").unlink()
    with raises_code("E203", r"log_0\.mcap: .*metadata\.yaml"):
        read_streams([log])


@pytest.mark.parametrize("text", ["a: [", "rosbag2_bagfile_information: 3", ""])
def test_broken_metadata_file_is_named(log: Path, text: str) -> None:
    (log / "metadata.yaml").write_text(text)
    with raises_code("E209", r"metadata\.yaml: "):
        read_streams([log])


def test_metadata_cannot_name_files_outside_the_bag(log: Path, tmp_path: Path) -> None:
    (tmp_path / "other.mcap").write_bytes((log / "log_0.mcap").read_bytes())
    content = yaml.safe_load((log / "metadata.yaml").read_text())
    listed = ["../other.mcap", str(tmp_path / "other.mcap")]
    content["rosbag2_bagfile_information"]["relative_file_paths"] = listed
    (log / "metadata.yaml").write_text(yaml.safe_dump(content))
    with raises_code("E203", r"log/other\.mcap: "):
        read_streams([log])


def test_damaged_sqlite_files_are_rejected(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RosbagsWriter(tmp_path / "log", version=9) as writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=STORE)
        for n in range(1000):
            writer.write(connection, n, joint_state(n, ["hip"], [0.0]))
    (file,) = (tmp_path / "log").glob("*.db3")
    assert len(read_streams([file]).joints.stamp) == 1000

    log = file.with_name(f"{file.name}-wal")
    log.write_bytes(b"no log at all")
    assert len(read_streams([file]).joints.stamp) == 1000
    assert "the recording was interrupted; its last messages are read from" in caplog.text
    assert log.read_bytes() == b"no log at all"
    log.unlink()

    content = file.read_bytes()
    for damaged in (content[: len(content) // 2], b"SQLite format 3\0", b"", content[::-1]):
        file.write_bytes(damaged)
        with pytest.raises(BagError, match=r"damaged SQLite file|no sensor_msgs"):
            read_streams([file])
