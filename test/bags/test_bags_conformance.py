"""Each combination of MCAP features gives the same data."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_editing import topic_counts
from expected_errors import raises_code
from foreign_bags import STORE, imu, joint_state, wrench
from mcap.reader import NonSeekingReader
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap_features import (
    ALL,
    ATTACHMENT_INDEX,
    CHANNELS,
    CHUNK_INDEX,
    METADATA_INDEX,
    SCHEMAS,
    STATISTICS,
    SUMMARY_OFFSETS,
    feature_sets,
    mcap_image,
)

from symbid_ros.bags import Recording, bag_info, read_streams, recover
from symbid_ros.errors import BagError
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

SCHEMA = Schema(id=1, name="Example", encoding="c", data=b"\4\5\6")
CHANNEL = Channel(id=1, topic="example", message_encoding="a", metadata={"foo": "bar"}, schema_id=1)
BARE = Channel(id=1, topic="example", message_encoding="text", metadata={}, schema_id=0)
FILE = Attachment(
    create_time=1, log_time=2, name="myFile", media_type="application/octet-stream", data=b"\1\2\3"
)
NOTE = Metadata(name="myMetadata", metadata={"foo": "bar"})


def message(log_time: int = 2, publish_time: int = 1, sequence: int = 10) -> Message:
    return Message(
        channel_id=1,
        data=b"\1\2\3",
        log_time=log_time,
        publish_time=publish_time,
        sequence=sequence,
    )


TEN = [message(time, time, n) for n, time in enumerate([0, 2, 1, 3, 3, 5, 4, 7, 8, 9])]
FOREIGN: dict[str, list[McapRecord]] = {
    "NoData": [],
    "OneSchemalessMessage": [BARE, message()],
    "OneMessage": [SCHEMA, CHANNEL, message()],
    "OneAttachment": [FILE],
    "OneMetadata": [NOTE],
    "TenMessages": [SCHEMA, CHANNEL, *TEN],
}


def told(file: Path) -> tuple[list[Any], list[Attachment], list[Metadata]]:
    """What the mcap package finds in a file: messages with channel and schema, the rest."""
    with file.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        messages = [
            (
                schema and (schema.name, schema.encoding, schema.data),
                (channel.topic, channel.message_encoding, channel.metadata),
                (found.log_time, found.publish_time, found.sequence, found.data),
            )
            for schema, channel, found in reader.iter_messages(log_time_order=False)
        ]
    with file.open("rb") as stream:
        attachments = list(NonSeekingReader(stream).iter_attachments())
    with file.open("rb") as stream:
        notes = [n for n in NonSeekingReader(stream).iter_metadata() if n.name != "rosbag2"]
    return messages, attachments, notes


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_records_are_counted_and_copied(tmp_path: Path, name: str) -> None:
    records = FOREIGN[name]
    count = sum(isinstance(record, Message) for record in records)
    file = tmp_path / "log.mcap"
    file.write_bytes(mcap_image(records, frozenset()))
    plain = told(file)
    for number, features in enumerate(feature_sets(records)):
        file.write_bytes(mcap_image(records, features))
        info = bag_info(file)
        (part,) = info.files
        assert info.count == count, features
        assert sum(topic_counts(file).values()) == count, features
        assert (part.attachments, part.metadata) == (records == [FILE], records == [NOTE]), features
        assert (part.is_finished, part.fault) == (True, "")
        with pytest.raises(BagError, match="no sensor_msgs/msg/JointState topic") as caught:
            read_streams([file])
        assert "\n" not in str(caught.value)
        if features & {CHUNK_INDEX, SUMMARY_OFFSETS} or {SCHEMAS, CHANNELS} <= features:
            continue  # recovery looks at none of the former, and the latter are read like one
        out = tmp_path / str(number)
        if not records:
            with raises_code("E221"):
                recover(file, out)
            continue
        recovery = recover(file, out)
        assert recovery.is_whole, features
        assert not recovery.holes, features
        assert (recovery.kept, recovery.lost) == (count, 0), features
        assert (recovery.attachments.kept, recovery.metadata.kept) == (
            part.attachments,
            part.metadata,
        )
        assert told(out / f"{number}_0.mcap") == plain, features


def sensor_records() -> tuple[list[McapRecord], np.ndarray]:
    """A robot's topics, and the numbers (N, 3) in them: position, angular rate, force."""
    kinds = [("/joint_states", JOINT_STATE), ("/imu/data", IMU), ("/left_foot/wrench", WRENCH)]
    records: list[McapRecord] = []
    for number, (topic, msgtype) in enumerate(kinds, start=1):
        text = STORE.generate_msgdef(msgtype, ros_version=2)[0].encode()
        records.append(Schema(id=number, name=msgtype, encoding="ros2msg", data=text))
        records.append(
            Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=number)
        )
    values = np.random.default_rng(0).standard_normal((20, 3))
    for n, (position, rate, force) in enumerate(values.tolist(), start=1):
        stamp = n * 1_000_000
        payloads = (
            joint_state(stamp, ["hip"], [position], [0.0], [0.0]),
            imu(stamp, (rate, 0.0, 0.0)),
            wrench(stamp, (force, 0.0, 0.0)),
        )
        for channel, payload in enumerate(payloads, start=1):
            records.append(
                Message(
                    channel_id=channel,
                    data=payload,
                    log_time=stamp,
                    publish_time=stamp,
                    sequence=n,
                )
            )
        if n == 10:
            records += [FILE, NOTE]
    return records, values


def test_sensor_arrays_do_not_depend_on_mcap_features(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    records, values = sensor_records()
    file = tmp_path / "log.mcap"
    for features in feature_sets(records):
        if features & {ATTACHMENT_INDEX, METADATA_INDEX}:
            continue  # what lies beside the messages is met in the next test
        file.write_bytes(mcap_image(records, features))
        streams = read_streams([file])
        read = (
            streams.joints.position[:, 0],
            streams.imus[0].angular_velocity[:, 0],
            streams.wrenches[0].force[:, 0],
        )
        assert np.array_equal(np.transpose(read), values), features
    assert not caplog.records


def test_replay_and_recovery_do_not_depend_on_mcap_features(tmp_path: Path) -> None:
    """One combination for each feature that is there alone, and one for each that is missing."""
    records, values = sensor_records()
    file = tmp_path / "log.mcap"
    sets = list(feature_sets(records))
    extremes = [s for s in sets if len(s) <= 1 or len(s) >= max(map(len, sets)) - 1]
    payloads = sorted(record.data for record in records if isinstance(record, Message))
    for number, features in enumerate(extremes):
        file.write_bytes(mcap_image(records, features))
        recording = Recording.of([file])
        assert sorted(m.payload for m in played(recording)) == payloads, features
        recovery = recover(file, tmp_path / str(number))
        assert recovery.is_whole, features
        assert np.array_equal(read_streams([recovery.out]).joints.position[:, 0], values[:, 0])


def played(recording: Recording) -> Sequence[Any]:
    return list(recording.messages(set(recording.topics), recording.start, recording.end + 1))


def test_summary_groups_in_any_order_are_read(tmp_path: Path) -> None:
    records, values = sensor_records()
    file = tmp_path / "log.mcap"
    for features in ({SCHEMAS, CHANNELS, STATISTICS}, {SCHEMAS, CHANNELS}, set(ALL)):
        file.write_bytes(mcap_image(records, frozenset(features), backwards=True))
        assert np.array_equal(read_streams([file]).joints.position[:, 0], values[:, 0])
        assert bag_info(file).count == 3 * len(values)
