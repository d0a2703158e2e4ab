"""metadata.yaml: times and counts of all files together."""

from pathlib import Path

import pytest
import yaml

from symbid_ros.bags.container.files import read_metadata
from symbid_ros.bags.metadata import (
    FileMetadata,
    TopicMetadata,
    describe_bag,
    encode_metadata_record,
    write_metadata,
)
from symbid_ros.messages.topics import OfferedQos

TOPICS = {
    1: TopicMetadata("/imu", "sensor_msgs/msg/Imu", (OfferedQos(),), "hash"),
    4: TopicMetadata("/silent", "sensor_msgs/msg/Imu", (), "hash"),
    7: TopicMetadata("/joints", "sensor_msgs/msg/JointState", (OfferedQos(),), "hash"),
}
FIRST = FileMetadata("log_0.mcap", 50, 80, {1: 3, 7: 2})
SECOND = FileMetadata("log_1.mcap", 30, 70, {1: 4})
EMPTY = FileMetadata("log_2.mcap", 0, 0, {})


@pytest.mark.parametrize(
    ("files", "start", "duration", "counts"),
    [
        ((FIRST, SECOND, EMPTY), 30, 50, [7, 0, 2]),
        ((EMPTY, FIRST), 50, 30, [3, 0, 2]),
        ((EMPTY,), 0, 0, [0, 0, 0]),
        ((), 0, 0, [0, 0, 0]),
    ],
)
def test_times_and_counts_are_those_of_all_files(files, start, duration, counts):
    found = describe_bag(TOPICS, files)
    assert found["starting_time"] == {"nanoseconds_since_epoch": start}
    assert found["duration"] == {"nanoseconds": duration}
    assert found["message_count"] == sum(counts)
    topics = found["topics_with_message_count"]
    assert [each["message_count"] for each in topics] == counts
    assert [each["topic_metadata"]["name"] for each in topics] == ["/imu", "/silent", "/joints"]
    assert found["relative_file_paths"] == [file.name for file in files]
    assert [file["message_count"] for file in found["files"]] == [file.count for file in files]
    assert (found["compression_format"], found["compression_mode"]) == ("", "")


def test_a_file_states_its_own_times():
    assert FIRST.as_dict() == {
        "path": "log_0.mcap",
        "starting_time": {"nanoseconds_since_epoch": 50},
        "duration": {"nanoseconds": 30},
        "message_count": 5,
    }


def test_metadata_replace_an_earlier_file_and_are_in_the_record(tmp_path: Path):
    found = describe_bag(TOPICS, (FIRST,), "MESSAGE")
    assert (found["compression_format"], found["compression_mode"]) == ("zstd", "MESSAGE")
    (tmp_path / "metadata.yaml").write_text("earlier")
    write_metadata(tmp_path, found)
    assert [file.name for file in tmp_path.iterdir()] == ["metadata.yaml"]
    read = yaml.safe_load((tmp_path / "metadata.yaml").read_text())
    assert read == {"rosbag2_bagfile_information": found}
    record = encode_metadata_record(found)
    assert yaml.safe_load(record["serialized_metadata"]) == found


def test_metadata_that_change_are_read_again(tmp_path: Path):
    path = tmp_path / "metadata.yaml"
    for files in ((FIRST,), (FIRST, SECOND)):
        information = describe_bag(TOPICS, files)
        path.write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
        for _ in range(2):
            assert read_metadata(path) == information
