"""Reading bags."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_editing import topic_counts
from expected_errors import raises_code
from foreign_bags import STORE, imu, joint_state, joints_only, wrench, write_rosbags
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from symbid_ros.bags import read_streams, read_truth
from symbid_ros.errors import DataError
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.messages.types import ACCEL, IMU, JOINT_STATE, WRENCH
from symbid_ros.simulation.recording import record

MILLISECOND = 1_000_000


def test_arrays_equal_the_simulation_bit_for_bit(robot, log: Path) -> None:
    streams = read_streams([log])
    stamp = robot.all("stamp")
    assert streams.joints.names == robot.joint_names
    assert np.array_equal(streams.joints.stamp, stamp)
    assert np.array_equal(streams.joints.position, robot.all("joint_position"))
    assert np.array_equal(streams.joints.velocity, robot.all("joint_velocity"))
    assert np.array_equal(streams.joints.effort, robot.all("joint_effort"))
    (imu_stream,) = streams.imus
    assert (imu_stream.topic, imu_stream.frame_id) == ("/imu/data", "imu_link")
    assert np.array_equal(imu_stream.orientation, robot.all("imu_orientation"))
    assert np.array_equal(imu_stream.angular_velocity, robot.all("imu_angular_velocity"))
    assert np.array_equal(imu_stream.linear_acceleration, robot.all("imu_linear_acceleration"))
    left, right = streams.wrenches
    assert (left.frame_id, right.frame_id) == ("left_sole", "right_sole")
    assert np.array_equal(right.stamp, stamp)
    assert np.array_equal(np.hstack([right.force, right.torque]), robot.all("wrenches")[:, 1])


def test_truth_equals_the_simulation(robot, log: Path) -> None:
    truth = read_truth([log])
    assert truth.joint_names == robot.joint_names
    assert np.array_equal(truth.stamp, robot.all("stamp"))
    for name in ("position", "velocity", "acceleration", "effort"):
        assert np.array_equal(getattr(truth, name), robot.all(f"true_{name}"))
    for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
        assert np.array_equal(getattr(truth, f"base_{name}"), robot.all(f"base_{name}"))
    for name in ("base_linear_acceleration", "base_angular_acceleration"):
        assert np.array_equal(getattr(truth, name), robot.all(name))


def test_topic_counts_equal_the_written_messages(robot, log: Path) -> None:
    counts = topic_counts(log)
    assert set(counts.values()) == {robot.steps}
    assert len(counts) == 7


def rosbags_copy(
    log: Path,
    target: Path,
    compression: CompressionMode = CompressionMode.NONE,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> None:
    writer = RosbagsWriter(target, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with AnyReader([log]) as reader, writer:
        targets = {
            connection.topic: writer.add_connection(
                connection.topic, connection.msgtype, typestore=STORE
            )
            for connection in reader.connections
        }
        for connection, time, raw in reader.messages():
            writer.write(targets[connection.topic], time, raw)


def mcap_copy(log: Path, target: Path, **options: Any) -> None:
    target.mkdir()
    with AnyReader([log]) as reader, (target / f"{target.name}_0.mcap").open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start("ros2")
        channels = {
            connection.topic: writer.register_channel(
                connection.topic,
                "cdr",
                writer.register_schema(connection.msgtype, "ros2msg", b""),
            )
            for connection in reader.connections
        }
        for connection, time, raw in reader.messages():
            writer.add_message(channels[connection.topic], time, bytes(raw), time)
        writer.finish()


@pytest.mark.parametrize(
    "copy",
    [
        rosbags_copy,
        lambda log, to: rosbags_copy(log, to, CompressionMode.STORAGE),
        lambda log, to: mcap_copy(log, to, compression=CompressionType.LZ4, chunk_size=20_000),
        lambda log, to: mcap_copy(log, to, compression=CompressionType.NONE),
        lambda log, to: mcap_copy(log, to, use_chunking=False),
        lambda log, to: mcap_copy(log, to, index_types=IndexType.NONE),
        lambda log, to: rosbags_copy(log, to, storage=StoragePlugin.SQLITE3),
    ],
    ids=[
        "rosbags",
        "rosbags-zstd",
        "mcap-lz4",
        "mcap-plain",
        "mcap-unchunked",
        "mcap-unindexed",
        "sqlite",
    ],
)
def test_bags_of_other_writers_read_the_same(
    log: Path, tmp_path: Path, copy: Callable[[Path, Path], None]
) -> None:
    copy(log, tmp_path / "copy")
    ours, theirs = read_streams([log]), read_streams([tmp_path / "copy"])
    assert np.array_equal(ours.joints.effort, theirs.joints.effort)
    assert np.array_equal(ours.imus[0].angular_velocity, theirs.imus[0].angular_velocity)
    assert np.array_equal(ours.wrenches[0].force, theirs.wrenches[0].force)
    assert topic_counts(log) == topic_counts(tmp_path / "copy")


def test_file_and_folder_are_the_same_bag(log: Path) -> None:
    file = log / "log_0.mcap"
    assert np.array_equal(read_streams([log]).joints.stamp, read_streams([file]).joints.stamp)


def test_bags_in_sequence_are_one_recording(make_robot, tmp_path: Path) -> None:
    first, second = make_robot(steps=100), make_robot(steps=50, seed=1)
    record(first, tmp_path / "a")
    step = second.step

    def later() -> Any:
        return replace(step(), stamp=second.instants[-1].stamp + 100 * MILLISECOND)

    second.step = later
    record(second, tmp_path / "b")
    streams = read_streams([tmp_path / "a", tmp_path / "b"])
    assert np.array_equal(streams.joints.stamp, np.arange(1, 151) * MILLISECOND)
    assert np.array_equal(
        streams.joints.effort,
        np.concatenate([first.all("joint_effort"), second.all("joint_effort")]),
    )


def test_two_runs_are_rejected_as_one_recording(make_robot, tmp_path: Path) -> None:
    for name in ("a", "b"):
        record(make_robot(steps=1200), tmp_path / name)
    with pytest.raises(DataError, match=r"header stamps jump back by 1.199 s after 1.200 s"):
        read_streams([tmp_path / "a", tmp_path / "b"])


def test_reordered_joints_are_matched_by_name(tmp_path: Path) -> None:
    bag = joints_only(
        tmp_path / "log",
        joint_state(1, ["hip", "knee"], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0]),
        joint_state(2, ["knee", "hip"], [20.0, 10.0], [40.0, 30.0], [60.0, 50.0]),
        joint_state(3, ["hip", "knee"], [1.5, 2.5], [3.5, 4.5], [5.5, 6.5]),
    )
    joints = read_streams([bag]).joints
    assert joints.names == ("hip", "knee")
    assert joints.position.tolist() == [[1, 2], [10, 20], [1.5, 2.5]]
    assert joints.velocity.tolist() == [[3, 4], [30, 40], [3.5, 4.5]]
    assert joints.effort.tolist() == [[5, 6], [50, 60], [5.5, 6.5]]


def test_absent_values_are_nan(tmp_path: Path) -> None:
    bag = joints_only(
        tmp_path / "log",
        joint_state(1, ["hip", "knee"], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0]),
        joint_state(2, ["knee"], [2.0], [4.0], [6.0]),
        joint_state(3, ["hip", "knee"], [1.0, 2.0], [], []),
        joint_state(4, ["hip", "knee"], [1.0, 2.0], [3.0], [5.0]),
        joint_state(5, [], [1.0, 2.0]),
    )
    joints = read_streams([bag]).joints
    nan = np.nan
    np.testing.assert_array_equal(joints.position, [[1, 2], [nan, 2], [1, 2], [1, 2], [nan, nan]])
    np.testing.assert_array_equal(joints.effort, [[5, 6], [nan, 6], *[[nan, nan]] * 3])


def test_messages_without_a_common_layout_are_decoded_one_by_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = joints_only(
        tmp_path / "log",
        *(joint_state(n, ["hip"], [n], [n], [n], little_endian=n % 3 > 0) for n in range(1, 31)),
    )
    joints = read_streams([bag]).joints
    assert joints.effort[:, 0].tolist() == list(range(1, 31))
    assert "10 of 30 messages have irregular bytes" in caplog.text


def test_many_layouts_are_read(tmp_path: Path) -> None:
    sizes = [1 + n % 60 for n in range(180)]
    bag = joints_only(
        tmp_path / "log",
        *(
            joint_state(n + 1, [f"j{i}" for i in range(size)], np.arange(size) + n)
            for n, size in enumerate(sizes)
        ),
    )
    joints = read_streams([bag]).joints
    assert joints.names == ("j0",)
    assert joints.position[:, 0].tolist() == list(range(180))


def test_padding_and_trailing_bytes_of_fast_cdr_are_accepted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    plain = joint_state(1, ["hip", "k"], [1.0, 2.0], [], [5.0, 6.0])
    foreign = bytearray(joint_state(2, ["hip", "k"], [1.0, 2.0], [], [7.0, 8.0]) + b"\7" * 8)
    foreign[17:20] = b"\xbd\xc1\x84"  # behind the empty frame_id, as Fast CDR leaves it
    bag = joints_only(tmp_path / "log", bytes(foreign), plain)
    with caplog.at_level(logging.WARNING):
        joints = read_streams([bag]).joints
    assert joints.effort.tolist() == [[5, 6], [7, 8]]
    assert "one by one" not in caplog.text


def test_messages_are_sorted_and_repeated_stamps_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = [3, 1, 2, 2, 4]
    bag = joints_only(
        tmp_path / "log", *(joint_state(s, ["hip"], [n]) for n, s in enumerate(stamps))
    )
    joints = read_streams([bag]).joints
    assert joints.stamp.tolist() == [1, 2, 3, 4]
    assert joints.position[:, 0].tolist() == [1, 2, 0, 4]
    assert "1 of 5 messages are out of order" in caplog.text
    assert "1 of 5 messages repeat a stamp" in caplog.text


def test_orientation_marked_absent_is_none(tmp_path: Path) -> None:
    joint = ("/joint_states", JOINT_STATE, joint_state(1, ["hip"], [0.0]))
    bag = write_rosbags(
        tmp_path / "log",
        [
            joint,
            *(("/a/imu", IMU, imu(n, covariance=-1.0)) for n in range(3)),
            *(("/b/imu", IMU, imu(n)) for n in range(3)),
        ],
    )
    absent, present = read_streams([bag]).imus
    assert absent.orientation is None
    assert present.orientation.tolist() == [[0, 0, 0, 1]] * 3


def test_explicit_topics_with_and_without_slash(tmp_path: Path) -> None:
    state = joint_state(1, ["hip"], [0.0])
    bag = write_rosbags(
        tmp_path / "log",
        [
            ("/left/joint_states", JOINT_STATE, state),
            ("/right/joint_states", JOINT_STATE, state),
            ("/imu", IMU, imu(1)),
            ("/plate", WRENCH, wrench(1, (0.0, 0.0, 1.0))),
            ("/foot/wrench", WRENCH, wrench(1, (0.0, 0.0, 2.0))),
        ],
    )
    chosen = TopicSelection(joints=("left/joint_states",), imus=(), wrenches=("/plate",))
    streams = read_streams([bag], chosen)
    assert streams.joints.topic == "/left/joint_states"
    assert streams.imus == ()
    assert [stream.topic for stream in streams.wrenches] == ["/plate"]
    by_name = read_streams([bag], TopicSelection(joints=("/left/joint_states",)))
    assert [stream.topic for stream in by_name.wrenches] == ["/foot/wrench"]
    with raises_code("E212", r"/left.*, /right"):
        read_streams([bag])


def test_ground_truth_is_never_selected(log: Path) -> None:
    with raises_code("E214", "/ground_truth/joint_states"):
        TopicSelection(joints=("/ground_truth/joint_states",))
    assert not any("ground_truth" in stream.topic for stream in read_streams([log]).wrenches)


def test_truth_keeps_the_common_instants_of_its_topics(
    robot, log: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with AnyReader([log]) as reader:
        kept = [
            (connection.topic, connection.msgtype, bytes(raw))
            for connection, time, raw in reader.messages()
            if not (connection.msgtype == ACCEL and time == 7 * MILLISECOND)
        ]
    truth = read_truth([write_rosbags(tmp_path / "cut", kept)])
    assert len(truth.stamp) == robot.steps - 1
    assert 7 * MILLISECOND not in truth.stamp
    rows = robot.all("stamp") != 7 * MILLISECOND
    assert np.array_equal(truth.effort, robot.all("true_effort")[rows])
    assert "1 instants lack one of its topics" in caplog.text
