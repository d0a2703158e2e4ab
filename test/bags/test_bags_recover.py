"""Recovery of interrupted and damaged bags, and its report."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from expected_errors import raises_code
from foreign_bags import STORE, joint_state
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader as RosbagsReader

from symbid_ros.bags import BagWriter, RecoveryReport, bag_info, read_streams, recover
from symbid_ros.bags.recovery.report import RecordCount
from symbid_ros.errors import BagError
from symbid_ros.messages.types import JOINT_STATE

MAGIC = 8
CHUNK, MESSAGE_INDEX, DATA_END = 6, 7, 15
STEPS = 200
DEADLINE = 300.0  # s; only a hang takes as long


def write(bag: Path, *, first: int = 0, steps: int = STEPS) -> Path:
    """Two topics, two messages a millisecond, some 40 chunks."""
    draw = np.random.default_rng(first).standard_normal
    with BagWriter(bag, chunk_size=1000) as writer:
        joints = writer.add_topic("/joint_states", JOINT_STATE)
        text = writer.add_topic("/log", "std_msgs/msg/String")
        for n in range(first + 1, first + steps + 1):
            time = n * 1_000_000
            writer.write(joints, time, joint_state(time, ["hip"], draw(1), draw(1), draw(1)))
            writer.write(text, time, b"\0\1\0\0\2\0\0\0a\0")
    return bag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write(tmp_path / "log")


@pytest.fixture
def file(bag: Path) -> Path:
    return bag / "log_0.mcap"


def records(image: bytes) -> Iterator[tuple[int, int, int]]:
    position = MAGIC
    while position < len(image) - MAGIC:
        opcode, length = struct.unpack_from("<BQ", image, position)
        yield opcode, position, position + 9 + length
        position += 9 + length


def chunks(image: bytes) -> list[tuple[int, int]]:
    return [(start, end) for opcode, start, end in records(image) if opcode == CHUNK]


def by_topic(recovery: RecoveryReport) -> dict[str, tuple[int, int]]:
    return {topic.name: (topic.kept, topic.lost) for topic in recovery.topics}


def messages(bag: Path) -> list[tuple[str, int, bytes]]:
    """Read all messages of a bag with another library."""
    with AnyReader([bag]) as reader:
        return [(link.topic, time, bytes(raw)) for link, time, raw in reader.messages()]


def test_intact_bag_is_copied_completely(bag: Path) -> None:
    recovery = recover(bag)
    assert recovery.out == bag.with_name("log_recovered")
    assert recovery.is_whole
    assert by_topic(recovery) == {"/joint_states": (STEPS, 0), "/log": (STEPS, 0)}
    assert messages(recovery.out) == messages(bag)
    with RosbagsReader(bag) as old, RosbagsReader(recovery.out) as new:
        for name in ("message_count", "start_time", "end_time", "duration"):
            assert getattr(new, name) == getattr(old, name)
        for before, after in zip(old.connections, new.connections, strict=True):
            for name in ("topic", "msgtype", "msgdef", "digest", "msgcount", "ext"):
                assert getattr(after, name) == getattr(before, name)


def test_the_new_bag_is_beside_the_old_one_as_it_was_named(bag: Path, monkeypatch) -> None:
    monkeypatch.chdir(bag.parent)
    assert recover(Path("log")).out == Path("log_recovered")
    monkeypatch.chdir(bag)
    assert recover(Path(), bag.parent / "other").is_whole
    with raises_code("E218", str(bag.with_name("log_recovered"))):  # it exists
        recover(Path())


def test_complete_chunks_of_an_interrupted_recording_are_recovered(file: Path, bag: Path) -> None:
    """Truncated at different positions, the file keeps each complete chunk before the cut."""
    image = file.read_bytes()
    whole = messages(bag)
    places = chunks(image)
    (bag / "metadata.yaml").unlink()
    _, first_end = places[0]
    for cut in (first_end, places[5][0] + 4, places[5][0] + 300, places[9][1], places[9][1] + 20):
        file.write_bytes(image[:cut])
        for named in (bag, file):
            with raises_code("E205", f"`symbid bag recover {named}`"):
                read_streams([named])
        before = file.read_bytes()
        recovery = recover(bag)
        kept = messages(recovery.out)
        assert kept == whole[: len(kept)]
        with recovery.out.joinpath("log_recovered_0.mcap").open("rb") as stream:
            assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == len(
                kept
            )
        last = sum(end <= cut for _, end in places)
        times = struct.unpack_from("<QQ", image, places[last - 1][0] + 9)
        assert kept[-1][1] == times[1]
        assert file.read_bytes() == before
        assert sum(hole.length for hole in recovery.holes) == (
            0
            if cut in (first_end, places[9][1])
            else cut - max(p for p in starts(image) if p <= cut)
        )
        shutil.rmtree(recovery.out)


def starts(image: bytes) -> list[int]:
    return [start for _, start, _ in records(image)]


def test_messages_of_a_damaged_chunk_are_counted(file: Path) -> None:
    """Only the message index counts them: summary and metadata are missing."""
    image = bytearray(file.read_bytes())
    places = chunks(image)
    start, end = places[7]
    image[(start + end) // 2] ^= 4
    file.write_bytes(image[: places[20][0]])
    counts = sum(
        (stop - begin - 15) // 16
        for opcode, begin, stop in records(image)
        if opcode == MESSAGE_INDEX and end <= begin < places[8][0]
    )
    recovery = recover(file)
    (hole,) = recovery.holes
    assert (hole.offset, hole.length, hole.messages) == (start, end - start, counts)
    assert hole.is_counted
    assert recovery.is_counted
    assert recovery.lost == counts > 0
    assert not recovery.is_whole
    before, after = (struct.unpack_from("<QQ", image, places[n][0] + 9) for n in (6, 8))
    assert (hole.after, hole.before) == (before[1], after[0])
    assert recovery.out == file.with_name("log_0_recovered")


def test_summary_counts_lost_messages(file: Path) -> None:
    """Three chunks and their indexes are overwritten, so that only the summary counts them."""
    image = bytearray(file.read_bytes())
    places = chunks(image)
    first, last = places[4][0], places[7][0]
    image[first:last] = bytes(last - first)
    file.write_bytes(image)
    recovery = recover(file)
    kept = read_streams([recovery.out]).joints
    assert by_topic(recovery)["/joint_states"] == (len(kept.stamp), STEPS - len(kept.stamp))
    assert recovery.is_counted
    (hole,) = recovery.holes
    assert (hole.offset, hole.length) == (first, last - first)
    lost = set(range(1, STEPS + 1)) - set((kept.stamp // 1_000_000).tolist())
    assert min(lost) * 1_000_000 >= hole.after
    assert max(lost) * 1_000_000 <= hole.before


def test_metadata_counts_the_lost_messages_of_a_truncated_copy(file: Path, bag: Path) -> None:
    image = file.read_bytes()
    file.write_bytes(image[: len(image) // 2])
    recovery = recover(bag)
    assert recovery.is_counted
    assert recovery.kept + recovery.lost == 2 * STEPS
    assert 0 < recovery.kept < 2 * STEPS
    alone = recover(file)
    assert not alone.is_counted
    assert alone.kept == recovery.kept


@pytest.mark.parametrize("stated", [3, STEPS, STEPS + 50])
def test_lost_messages_follow_the_largest_stated_count(file: Path, bag: Path, stated: int) -> None:
    """A chunk is damaged; metadata.yaml counts fewer, equal or more messages than the summary."""
    image = bytearray(file.read_bytes())
    start, end = chunks(image)[7]
    image[(start + end) // 2] ^= 4
    file.write_bytes(image)
    metadata = bag / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    for entry in content["rosbag2_bagfile_information"]["topics_with_message_count"]:
        entry["message_count"] = stated
    metadata.write_text(yaml.safe_dump(content))
    recovery = recover(bag)
    kept = len(read_streams([recovery.out]).joints.stamp)
    assert kept < STEPS
    assert by_topic(recovery)["/joint_states"] == (kept, max(stated, STEPS) - kept)


def test_removed_or_inserted_bytes_cost_only_their_chunk(file: Path) -> None:
    image = file.read_bytes()
    places = chunks(image)
    place = places[5][0] + 200
    for spoiled in (image[:place] + image[place + 7 :], image[:place] + b"oops" + image[place:]):
        file.write_bytes(spoiled)
        recovery = recover(file)
        kept = set((read_streams([recovery.out]).joints.stamp // 1_000_000).tolist())
        begin, end = struct.unpack_from("<QQ", image, places[5][0] + 9)
        lost = set(range(1, STEPS + 1)) - kept
        assert lost
        assert lost <= set(range(begin // 1_000_000, end // 1_000_000 + 1))
        shutil.rmtree(recovery.out)


def test_repeated_chunk_is_copied_once(file: Path) -> None:
    image = file.read_bytes()
    start, end = chunks(image)[3]
    file.write_bytes(image[:end] + image[start:end] + image[end:])
    recovery = recover(file)
    assert recovery.repeated == 1
    assert recovery.kept == 2 * STEPS


def test_all_files_of_a_bag_are_recovered(tmp_path: Path) -> None:
    """One is intact, one truncated, one without footer; their channels have different numbers."""
    parts = [write(tmp_path / name, first=n * STEPS) for n, name in enumerate("abc")]
    bag = tmp_path / "log"
    bag.mkdir()
    for n, part in enumerate(parts):
        image = (part / f"{part.name}_0.mcap").read_bytes()
        places = chunks(image)
        end = {0: len(image), 1: places[10][0], 2: places[-1][1]}[n]
        (bag / f"log_{n}.mcap").write_bytes(image[:end])
    recovery = recover(bag, tmp_path / "new" / "saved")
    assert sorted(path.name for path in recovery.out.iterdir()) == [
        "metadata.yaml",
        "saved_0.mcap",
        "saved_1.mcap",
        "saved_2.mcap",
    ]
    kept = messages(recovery.out)
    assert len(kept) == recovery.kept
    assert set(kept) <= {message for part in parts for message in messages(part)}
    assert by_topic(recovery)["/joint_states"][0] == len(read_streams([recovery.out]).joints.stamp)


def test_foreign_types_keep_their_definition(tmp_path: Path) -> None:
    file = tmp_path / "foreign.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.LZ4)
        writer.start("ros2")
        schema = writer.register_schema("toy_msgs/msg/Toy", "ros2msg", b"float64 x # a toy\n")
        toys = writer.register_channel("/toy", "cdr", schema, {"topic_type_hash": "RIHS01_7"})
        other = writer.register_schema("Toy", "jsonschema", b"{}")
        jsons = writer.register_channel("/json", "json", other)
        for n in range(10):
            writer.add_message(toys, n, b"\0\1\0\0" + struct.pack("<d", n), n)
            writer.add_message(jsons, n, b"{}", n, sequence=n)
        writer.add_metadata("operator", {"name": "R. Daneel"})
        writer.add_attachment(1, 1, "photo", "image/png", b"png")
        writer.finish()
    recovery = recover(file)
    assert recovery.is_whole
    assert by_topic(recovery) == {"/toy": (10, 0), "/json": (10, 0)}
    assert recovery.attachments == RecordCount(kept=1, lost=0)
    assert recovery.metadata == RecordCount(kept=1, lost=0)
    with (recovery.out / "foreign_recovered_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for n, (definition, channel, message) in enumerate(reader.iter_messages("/toy")):
            assert definition.data == b"float64 x # a toy\n"
            assert channel.metadata == {"topic_type_hash": "RIHS01_7"}
            assert message.data == b"\0\1\0\0" + struct.pack("<d", n)
        for n, (definition, channel, message) in enumerate(reader.iter_messages("/json")):
            assert (definition.encoding, definition.data) == ("jsonschema", b"{}")
            assert (channel.message_encoding, channel.metadata) == ("json", {})
            assert (message.sequence, message.data) == (n, b"{}")
        (photo,) = reader.iter_attachments()
        names = {record.name: record.metadata for record in reader.iter_metadata()}
        summary = reader.get_summary()
    assert (photo.name, photo.media_type, photo.data) == ("photo", "image/png", b"png")
    assert summary is not None
    assert summary.statistics.attachment_count == len(summary.attachment_indexes) == 1
    assert names["operator"] == {"name": "R. Daneel"}
    assert "toy_msgs/msg/Toy" in names["rosbag2"]["serialized_metadata"]


def test_damaged_attachment_is_lost_and_others_are_kept(tmp_path: Path) -> None:
    """One is larger than the parts it is read in, one does not match its checksum."""
    file = tmp_path / "log.mcap"
    large = np.random.default_rng(0).bytes(3_000_000)
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2")
        writer.add_attachment(1, 2, "video", "video/mp4", large)
        writer.add_attachment(3, 4, "note", "text/plain", b"all is well")
        writer.add_metadata("operator", {"name": "R. Daneel"})
        writer.finish()
    image = file.read_bytes()
    file.write_bytes(image.replace(b"all is well", b"all is hell"))
    with_summary = recover(file)
    file.write_bytes(file.read_bytes()[: image.index(b"R. Daneel") + 9])
    without = recover(file, tmp_path / "cut")
    for recovery in (with_summary, without):
        assert not recovery.is_whole
        assert recovery.attachments == RecordCount(kept=1, lost=1)
        assert recovery.metadata == RecordCount(kept=1, lost=0)
        (hole, *_) = recovery.holes
        assert hole.fault == "an attachment does not match its checksum"
        (written,) = recovery.out.glob("*.mcap")
        with written.open("rb") as stream:
            (video,) = make_reader(stream).iter_attachments()
        assert (video.log_time, video.create_time, video.name) == (2, 1, "video")
        assert video.data == large


def test_private_records_are_copied(bag: Path, file: Path) -> None:
    image = file.read_bytes()
    place = chunks(image)[3][0]
    own = struct.pack("<BQ", 0x91, 2_000_000) + np.random.default_rng(0).bytes(2_000_000)
    file.write_bytes(image[:place] + own + image[place:])
    recovery = recover(bag)
    assert (recovery.kept, recovery.is_whole) == (2 * STEPS, True)
    (written,) = recovery.out.glob("*.mcap")
    assert own in written.read_bytes()
    assert len(read_streams([recovery.out]).joints.stamp) == STEPS


def test_topics_without_messages_are_kept(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log") as writer:
        joints = writer.add_topic("/joint_states", JOINT_STATE)
        writer.add_topic("/silent", "std_msgs/msg/String")
        writer.write(joints, 1, joint_state(1, ["hip"]))
    recovery = recover(tmp_path / "log")
    assert by_topic(recovery) == {"/joint_states": (1, 0), "/silent": (0, 0)}
    with RosbagsReader(recovery.out) as reader:
        assert {link.topic: link.msgcount for link in reader.connections} == {
            "/joint_states": 1,
            "/silent": 0,
        }


def test_messages_outside_of_chunks_are_recovered(tmp_path: Path) -> None:
    file = tmp_path / "flat.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream, use_chunking=False)
        writer.start("ros2")
        text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", text)
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for n in range(1, 101):
            writer.add_message(channel, n, joint_state(n, ["hip"], [n], [n], [n]), n)
        writer.finish()
    image = bytearray(file.read_bytes())
    messages = [start for opcode, start, _ in records(image) if opcode == 5]
    image[messages[40] : messages[42]] = b"\xff" * (messages[42] - messages[40])
    file.write_bytes(image)
    recovery = recover(file)
    kept = read_streams([recovery.out]).joints.position[:, 0].tolist()
    # Where the one before them ends cannot be confirmed: it is not trusted either.
    assert kept == [n for n in range(1, 101) if n not in (40, 41, 42)]
    assert by_topic(recovery) == {"/joint_states": (97, 3)}


def test_recovery_overwrites_nothing_and_leaves_nothing_behind(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with raises_code("E218", "there: "):
        recover(bag, tmp_path / "there")
    with raises_code("E201", "nowhere: "):
        recover(tmp_path / "nowhere")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "noise.mcap").write_bytes(np.random.default_rng(1).bytes(100_000))
    for name, fault in (("empty", "empty"), ("noise", "nothing in it can be recovered")):
        with pytest.raises(BagError, match=rf"{name}\.mcap: {fault}"):
            recover(tmp_path / f"{name}.mcap")
    (tmp_path / "file").write_text("no folder")
    with raises_code("E219"):
        recover(bag, tmp_path / "file" / "out")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["empty.mcap", "file", "log", "noise.mcap", "there"]


def stopped(bag: Path, number: signal.Signals) -> subprocess.Popen[bytes]:
    """Send a signal to ``symbid bag recover`` once it writes, and wait for its end."""
    process = subprocess.Popen(
        [Path(sys.executable).parent / "symbid", "bag", "recover", bag], stderr=subprocess.PIPE
    )
    while process.poll() is None and not [*bag.parent.glob(".log_recovered.*/*/*.mcap")]:
        time.sleep(0.001)
    process.send_signal(number)
    process.wait(DEADLINE)
    return process


def test_interrupted_recovery_leaves_no_bag(file: Path, bag: Path) -> None:
    size = file.stat().st_size
    os.truncate(file, 1 << 36)  # zeros without blocks on the disk, which take a minute to search
    for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        process = stopped(bag, number)
        assert process.returncode == status
        assert (b"interrupted" in process.stderr.read()) == (number == signal.SIGINT)
        assert [path.name for path in bag.parent.iterdir()] == ["log"]
    stopped(bag, signal.SIGKILL)
    (left,) = {path.name for path in bag.parent.iterdir()} - {"log"}
    assert left.startswith(".log_recovered.")
    os.truncate(file, size)
    assert recover(bag).is_whole


def test_an_unfinished_bag_is_described(file: Path, bag: Path) -> None:
    whole = bag_info(bag)
    assert whole.is_finished
    assert [(topic.name, topic.count) for topic in whole.topics] == [
        ("/joint_states", STEPS),
        ("/log", STEPS),
    ]
    assert (whole.start, whole.end) == (1_000_000, STEPS * 1_000_000)
    assert whole.topics[0].rate == pytest.approx(STEPS / (STEPS - 1) * 1000)
    image = file.read_bytes()
    file.write_bytes(image[: chunks(image)[8][0] + 10])
    cut = bag_info(bag)
    recovery = recover(bag)
    assert not cut.is_finished
    assert f"`symbid bag recover {bag}`" in cut.files[0].fault
    assert cut.count == recovery.kept
    assert {topic.name: topic.count for topic in cut.topics} == {
        topic.name: topic.kept for topic in recovery.topics
    }
    again = bag_info(recovery.out)
    assert (again.start, again.end, again.count) == (cut.start, cut.end, cut.count)
    json.dumps(cut.as_dict())
