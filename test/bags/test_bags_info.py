"""The description of a bag, from summaries and from the messages themselves."""

import json
from pathlib import Path

import pytest
from foreign_bags import IMU, JOINT_STATE, imu, joint_state, write_rosbags
from json_schemas import require_valid
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap_features import ALL, CHUNKS, MESSAGE_INDEX, mcap_image

from symbid_ros.bags import bag_info
from symbid_ros.errors import BagError

RECORDS = (
    Schema(id=1, name="pkg/Kind", encoding="", data=b""),
    Channel(id=4, topic="/a", message_encoding="cdr", metadata={}, schema_id=1),
    Channel(id=9, topic="/b", message_encoding="cdr", metadata={}, schema_id=1),
    *(
        Message(channel_id=number, log_time=time, publish_time=0, sequence=0, data=b"payload")
        for number, time in ((4, 3_000_000_000), (4, 1_000_000_000), (9, 2_000_000_000))
    ),
    Attachment(log_time=1, create_time=1, name="note", media_type="text", data=b"text"),
    Metadata(name="about", metadata={"key": "value"}),
    Metadata(name="more", metadata={}),
)


def described(folder: Path, features: set[str], *, records=RECORDS, cut: int = 0):
    file = folder / "log.mcap"
    image = mcap_image(records, frozenset(features))
    file.write_bytes(image[: len(image) - cut])
    return bag_info(file)


@pytest.mark.parametrize("features", [set(), {CHUNKS}, {CHUNKS, MESSAGE_INDEX}, set(ALL)])
@pytest.mark.parametrize("cut", [0, 9])
def test_counts_and_times_do_not_depend_on_a_summary(tmp_path: Path, features, cut: int) -> None:
    found = described(tmp_path, features, cut=cut)
    assert [(one.name, one.msgtype, one.count) for one in found.topics] == [
        ("/a", "pkg/msg/Kind", 2),
        ("/b", "pkg/msg/Kind", 1),
    ]
    assert [one.rate for one in found.topics] == [1.0, 0.5]
    assert (found.start, found.end) == (1_000_000_000, 3_000_000_000)
    assert (found.duration, found.count) == (2.0, 3)
    (file,) = found.files
    assert (file.name, file.storage) == ("log.mcap", "mcap")
    assert file.size == found.size == (tmp_path / "log.mcap").stat().st_size
    assert (file.attachments, file.metadata) == (1, 2)
    assert file.is_finished is found.is_finished is (cut == 0)
    assert (file.fault == "") is (cut == 0)
    assert file.compression == ()
    assert file.is_indexed is (features == set(ALL) and not cut)


def test_a_bag_without_messages_has_no_times(tmp_path: Path) -> None:
    found = described(tmp_path, set(ALL), records=RECORDS[:3])
    assert (found.start, found.end, found.duration, found.count) == (None, None, 0.0, 0)
    assert [(one.name, one.count, one.rate) for one in found.topics] == [
        ("/a", 0, None),
        ("/b", 0, None),
    ]
    one = described(tmp_path, set(ALL), records=RECORDS[:4])
    assert (one.start, one.end, one.duration) == (3_000_000_000, 3_000_000_000, 0.0)
    assert one.topics[0].rate is None
    document = one.as_dict()
    require_valid("bag_info", json.loads(json.dumps(document)))
    assert (document["count"], document["is_finished"]) == (1, True)
    assert document["start_ns"] == one.start
    assert document["files"][0]["counts"] == {"/a": 1, "/b": 0}
    assert document["topics"][0]["name"] == "/a"


def test_a_recording_is_described_as_rosbags_wrote_it(tmp_path: Path) -> None:
    second = 10**9
    messages = [("/imu", IMU, imu(n * second)) for n in range(1, 12)]
    messages += [("/joints", JOINT_STATE, joint_state(6 * second, ["hip"], [1.0]))]
    found = bag_info(write_rosbags(tmp_path / "log", messages))
    assert [(one.name, one.msgtype, one.count) for one in found.topics] == [
        ("/imu", IMU, 11),
        ("/joints", JOINT_STATE, 1),
    ]
    # They are recorded a nanosecond apart.
    assert found.duration == pytest.approx(11e-9)
    assert found.topics[0].rate == pytest.approx(11 / 11e-9)
    assert found.files[0].is_indexed


def test_a_file_that_is_no_bag_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"text")
    with pytest.raises(BagError, match="not an MCAP file"):
        bag_info(tmp_path / "log.mcap")
    # Beside other files of a bag it is described.
    (tmp_path / "log_0.mcap").write_bytes(mcap_image(RECORDS, frozenset(ALL)))
    found = bag_info(tmp_path)
    (wrong,) = (one for one in found.files if one.name == "log.mcap")
    assert "not an MCAP file" in wrong.fault
    assert not wrong.is_finished
    assert found.count == 3
