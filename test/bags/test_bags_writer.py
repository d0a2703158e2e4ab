"""Bags read by other libraries."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from expected_errors import raises_code
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from symbid_ros.bags import BagWriter
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.messages.types import IMU, WRENCH, fill_wrench, wrench_layout
from symbid_ros.simulation.recording import record

STORE = get_typestore(Stores.ROS2_JAZZY)


def wrench_payload(stamp: int) -> bytes:
    layout = wrench_layout("left_sole")
    one = layout.records(1)
    fill_wrench(layout.columns(one), stamp, wrench=np.arange(6.0))
    return one.tobytes()


def test_rosbags_reads_every_field_of_a_recording(robot, tmp_path: Path) -> None:
    counts = record(robot, tmp_path / "log")
    assert set(counts.values()) == {robot.steps}
    with AnyReader([tmp_path / "log"]) as reader:
        assert reader.message_count == sum(counts.values())
        seen = dict.fromkeys(counts, 0)
        for connection, log_time, raw in reader.messages():
            instant = robot.instants[seen[connection.topic]]
            seen[connection.topic] += 1
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert stamp == log_time == instant.stamp
            if connection.topic == "/joint_states":
                assert tuple(message.name) == robot.joint_names
                assert (message.effort == instant.joint_effort).all()
            elif connection.topic == "/ground_truth/joints":
                assert (message.points[0].accelerations == instant.true_acceleration).all()
            elif connection.topic.endswith("/wrench"):
                side = "left" if "left" in connection.topic else "right"
                assert message.header.frame_id == f"{side}_sole"
                assert message.wrench.torque.z == instant.wrenches[int(side == "right"), 5]
            elif connection.topic == "/ground_truth/odom":
                frames = (message.header.frame_id, message.child_frame_id)
                assert frames == ("world", "base_link")
                assert message.twist.twist.linear.x == instant.base_linear_velocity[0]
                assert message.pose.pose.orientation.w == instant.base_orientation[3]
            elif connection.topic == "/ground_truth/base_accel":
                assert message.accel.angular.y == instant.base_angular_acceleration[1]
            else:
                assert message.linear_acceleration.x == instant.imu_linear_acceleration[0]
    assert seen == counts


def test_mcap_package_finds_what_rosbag2_needs(robot, tmp_path: Path) -> None:
    counts = record(robot, tmp_path / "log")
    with (tmp_path / "log" / "log_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        records = list(reader.iter_metadata())
        assert sum(1 for _ in reader.iter_messages()) == sum(counts.values())
    assert header.profile == "ros2"
    assert summary.statistics.message_count == sum(counts.values())
    assert [entry.name for entry in records] == ["rosbag2", "rosbag2"]
    closing = yaml.safe_load(records[-1].metadata["serialized_metadata"])
    assert closing["message_count"] == sum(counts.values())
    by_topic = {channel.topic: channel for channel in summary.channels.values()}
    assert set(by_topic) == set(counts)
    for channel in by_topic.values():
        schema = summary.schemas[channel.schema_id]
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert channel.metadata["topic_type_hash"] == STORE.hash_rihs01(schema.name)
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["depth"] == 10
    wrench = summary.schemas[by_topic["/left_foot/wrench"].schema_id]
    text = wrench.data.decode()
    assert wrench.name == WRENCH
    assert text.count("=" * 80 + "\nMSG: ") == 4
    for part in ("std_msgs/Header", "geometry_msgs/Wrench", "geometry_msgs/Vector3"):
        assert f"\nMSG: {part}\n" in text


def test_metadata_file_is_rosbag2_version_9(robot, tmp_path: Path) -> None:
    counts = record(robot, tmp_path / "log")
    content = yaml.safe_load((tmp_path / "log" / "metadata.yaml").read_text())
    information = content["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["log_0.mcap"]
    assert information["files"][0]["message_count"] == information["message_count"]
    assert information["message_count"] == sum(counts.values())
    assert information["duration"]["nanoseconds"] == (robot.steps - 1) * 1_000_000
    assert information["starting_time"]["nanoseconds_since_epoch"] == 1_000_000
    assert {"compression_format", "compression_mode", "custom_data", "ros_distro"} <= set(
        information
    )
    for entry in information["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        assert entry["message_count"] == counts[topic["name"]]
        assert topic["serialization_format"] == "cdr"
        assert topic["type_description_hash"] == STORE.hash_rihs01(topic["type"])


def test_rosbags_reads_the_offered_qos(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log") as bag:
        topic = bag.add_topic(
            "/w", WRENCH, [OfferedQos(7, reliability="best_effort", durability="transient_local")]
        )
        bag.write(topic, 5, wrench_payload(3))
    with Reader(tmp_path / "log") as reader:
        (connection,) = reader.connections
        (qos,) = connection.ext.offered_qos_profiles
    assert (qos.depth, qos.reliability, qos.durability) == (
        7,
        QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL,
    )


def test_same_seed_writes_the_same_bytes(make_robot, tmp_path: Path) -> None:
    for name in ("one", "two"):
        record(make_robot(seed=4), tmp_path / name)
    payloads = []
    for name in ("one", "two"):
        with (tmp_path / name / f"{name}_0.mcap").open("rb") as stream:
            payloads.append([m.data for _, _, m in make_reader(stream).iter_messages()])
    assert payloads[0] == payloads[1]


def test_existing_target_is_rejected_and_kept(robot, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "notes.txt").write_text("mine")
    with raises_code("E218", "log: "):
        record(robot, tmp_path / "log")
    assert [file.name for file in (tmp_path / "log").iterdir()] == ["notes.txt"]


def test_failed_simulation_leaves_nothing(robot, tmp_path: Path) -> None:
    take_step = robot.step

    def stumble():
        if len(robot.instants) == 200:
            raise ArithmeticError
        return take_step()

    robot.step = stumble
    with pytest.raises(ArithmeticError):
        record(robot, tmp_path / "log")
    assert list(tmp_path.iterdir()) == []


def test_open_bag_has_no_metadata_file_until_closed(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "log")
    topic = bag.add_topic("/w", WRENCH)
    bag.write(topic, 5, wrench_payload(3))
    assert not (tmp_path / "log" / "metadata.yaml").exists()
    bag.close()
    assert (tmp_path / "log" / "metadata.yaml").exists()


def test_flushed_messages_are_in_the_file_of_a_killed_writer(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "log")
    topic = bag.add_topic("/w", WRENCH)
    for stamp in range(10):
        bag.write(topic, stamp, wrench_payload(stamp))
    bag.flush()
    image = (tmp_path / "log" / "log_0.mcap").read_bytes()
    bag.close()
    (tmp_path / "killed.mcap").write_bytes(image)
    found = []
    with (tmp_path / "killed.mcap").open("rb") as stream, suppress(EndOfFile):
        for entry in StreamReader(stream).records:  # ends by EndOfFile: what came counts
            found += [entry] if isinstance(entry, Message) else []
    assert [message.log_time for message in found] == list(range(10))


def test_topic_errors_name_the_topic(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log") as bag:
        bag.add_topic("/imu", IMU)
        with raises_code("E222", "/imu"):
            bag.add_topic("/imu", IMU)
        with raises_code("E215", r"/x: .*foo_msgs/msg/Bar"):
            bag.add_topic("/x", "foo_msgs/msg/Bar")


def test_unwritable_path_raises_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with raises_code("E219", "Not a directory; check its permissions or choose another folder"):
        BagWriter(tmp_path / "file" / "log")


def test_progress_ends_at_the_number_of_steps(robot, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    record(robot, tmp_path / "log", progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (robot.steps, robot.steps)
    assert calls == sorted(calls)
