"""Replay yields recorded messages in order of log time, whichever program wrote the bag."""

import tracemalloc
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import write_rosbags
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_features import MAGIC, encoded

from symbid_ros.bags import BagWriter, RecordedMessage, Recording
from symbid_ros.errors import BagError
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.messages.types import IMU, JOINT_STATE

STRING = "std_msgs/msg/String"
TYPES = {"/a": JOINT_STATE, "/b": IMU, "/c": STRING}
WRITERS = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "unindexed": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
    "no statistics": {"use_statistics": False},
    "no channels": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}


def random_messages(count: int, seed: int = 0) -> list[RecordedMessage]:
    """Messages with distinct times that overtake each other by up to 40 periods, beyond a chunk."""
    draw = np.random.default_rng(seed)
    times = np.argsort(np.argsort(np.arange(count) + draw.uniform(0, 40, count)))
    return [
        RecordedMessage(
            1_000_000 + 1000 * int(time),
            str(draw.choice(list(TYPES))),
            b"\0\1\0\0" + draw.bytes(int(draw.integers(20, 120))),
        )
        for time in times
    ]


def write_mcap(
    file: Path, messages: Sequence[RecordedMessage], encoding: str = "cdr", **options: Any
) -> Path:
    with file.open("wb") as stream:
        writer = McapWriter(stream, **({"chunk_size": 2000} | options))
        writer.start("ros2")
        channels = {
            topic: writer.register_channel(
                topic, encoding, writer.register_schema(kind, "ros2msg", b"")
            )
            for topic, kind in TYPES.items()
        }
        for message in messages:
            writer.add_message(
                channels[message.topic], message.log_time, message.payload, message.log_time
            )
        writer.finish()
    return file


def everything(recording: Recording) -> list[RecordedMessage]:
    return list(recording.messages(recording.topics, recording.start, recording.end + 1))


@dataclass(frozen=True)
class Oddity:
    """Differences of a file from the output of most writers.

    ``outside`` and ``unindexed`` are the numbers of the chunks that are written as plain messages
    and without message index; ``times`` replaces those of the chunks; ``stated`` is added to the
    number of messages that the summary counts.
    """

    outside: frozenset[int] = frozenset()
    unindexed: frozenset[int] = frozenset()
    times: Callable[[int, int], tuple[int, int]] = lambda start, end: (start, end)
    stated: int = 0


def write_odd_mcap(file: Path, messages: Sequence[RecordedMessage], oddity: Oddity) -> Path:
    """Write a file of plain chunks, 20 messages each, record by record."""
    announced: list[McapRecord] = []
    for number, (topic, kind) in enumerate(TYPES.items(), 1):
        announced.append(Schema(id=number, name=kind, encoding="ros2msg", data=b""))
        announced.append(
            Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=number)
        )
    data = MAGIC + b"".join(map(encoded, [Header(profile="ros2", library=""), *announced]))
    indexes = []
    for number, first in enumerate(range(0, len(messages), 20)):
        records = [
            Message(
                channel_id=1 + list(TYPES).index(message.topic),
                data=message.payload,
                log_time=message.log_time,
                publish_time=message.log_time,
                sequence=0,
            )
            for message in messages[first : first + 20]
        ]
        raw = b"".join(map(encoded, records))
        if number in oddity.outside:
            data += raw
            continue
        times = [record.log_time for record in records]
        start, end = oddity.times(min(times), max(times))
        chunk = Chunk(
            compression="",
            data=raw,
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=len(raw),
        )
        entries = {channel: [] for channel in {record.channel_id for record in records}}
        position = 0
        for record in records:
            entries[record.channel_id].append((record.log_time, position))
            position += len(encoded(record))
        message_indexes = b""
        if number not in oddity.unindexed:
            message_indexes = b"".join(
                encoded(MessageIndex(channel_id=channel, records=places))
                for channel, places in entries.items()
            )
        indexes.append(
            ChunkIndex(
                chunk_length=len(encoded(chunk)),
                chunk_start_offset=len(data),
                compression="",
                compressed_size=len(raw),
                message_end_time=end,
                message_index_length=len(message_indexes),
                message_index_offsets=dict.fromkeys(entries if message_indexes else (), 1),
                message_start_time=start,
                uncompressed_size=len(raw),
            )
        )
        data += encoded(chunk) + message_indexes
    data += encoded(DataEnd(data_section_crc=0))
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(TYPES),
        channel_message_counts={},
        chunk_count=len(indexes),
        message_count=len(messages) + oddity.stated,
        message_end_time=max(message.log_time for message in messages),
        message_start_time=min(message.log_time for message in messages),
        metadata_count=0,
        schema_count=len(TYPES),
    )
    footer = Footer(summary_start=len(data), summary_offset_start=0, summary_crc=0)
    file.write_bytes(
        data + b"".join(map(encoded, [*announced, statistics, *indexes, footer])) + MAGIC
    )
    return file


@pytest.mark.parametrize(
    "oddity",
    [
        Oddity(),
        Oddity(outside=frozenset({3, 4, 29})),
        Oddity(unindexed=frozenset({0, 7})),
        Oddity(times=lambda start, end: (end, start)),
        Oddity(times=lambda start, end: (0, 0)),
        Oddity(frozenset({1}), frozenset({2}), lambda start, end: (end, start)),
    ],
    ids=["none", "messages outside chunks", "no message index", "reversed", "no times", "all"],
)
def test_no_message_is_skipped_silently(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, oddity: Oddity
) -> None:
    messages = random_messages(600)
    file = write_odd_mcap(tmp_path / "log.mcap", messages, oddity)
    recording = Recording.of([file])
    assert (recording.start, recording.end) == (1_000_000, 1_599_000)
    assert everything(recording) == sorted(messages)
    assert not caplog.records


def test_wrong_message_counts_cause_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = write_odd_mcap(tmp_path / "good.mcap", random_messages(300, 1), Oddity())
    file = write_odd_mcap(tmp_path / "log.mcap", random_messages(300), Oddity(stated=1))
    recording = Recording.of([good, file])
    part = recording.messages(recording.topics, recording.start, recording.start + 1000)
    assert len(list(part)) == 2
    assert not caplog.records  # most chunks were not read
    for _ in range(2):
        assert len(everything(recording)) == 600
    (warning,) = caplog.messages
    assert warning.startswith(f"{file}: damaged: its summary counts 301 messages, but it holds 300")


@pytest.mark.parametrize("options", WRITERS.values(), ids=WRITERS)
def test_messages_are_sorted_and_unchanged(tmp_path: Path, options: dict[str, Any]) -> None:
    messages = random_messages(600)
    recording = Recording.of([write_mcap(tmp_path / "log.mcap", messages, **options)])
    assert {name: topic.msgtype for name, topic in recording.topics.items()} == TYPES
    assert (recording.start, recording.end) == (1_000_000, 1_599_000)
    assert everything(recording) == sorted(messages)


def test_equal_times_keep_the_order_of_recording(tmp_path: Path) -> None:
    messages = [
        RecordedMessage(1000 + step // 50, "/a", b"\0\1\0\0" + step.to_bytes(4, "little") * 10)
        for step in range(500)
    ]
    recording = Recording.of([write_mcap(tmp_path / "log.mcap", messages, chunk_size=500)])
    assert everything(recording) == messages


def test_files_are_merged(tmp_path: Path) -> None:
    messages = random_messages(600)
    files = [write_mcap(tmp_path / f"{n}.mcap", messages[n::3]) for n in range(3)]
    assert everything(Recording.of(files)) == sorted(messages)


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=["indexed", "unindexed"])
def test_time_range_and_topics_are_selected(tmp_path: Path, options: dict[str, Any]) -> None:
    messages = random_messages(600)
    recording = Recording.of([write_mcap(tmp_path / "log.mcap", messages, **options)])
    start, stop = 1_100_000, 1_333_000
    part = list(recording.messages(["/a", "/c"], start, stop))
    assert part == sorted(m for m in messages if m.topic != "/b" and start <= m.log_time < stop)


def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    draw, count = np.random.default_rng(0), 400
    with BagWriter(tmp_path / "bag") as bag:
        channel = bag.add_topic("/c", STRING)
        for step in range(count):
            bag.write(channel, step, b"\0\1\0\0" + draw.bytes(50_000))
    tracemalloc.start()
    try:
        recording = Recording.of([tmp_path / "bag"])
        read = sum(len(message.payload) for message in recording.messages({"/c"}, 0, count))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert read == count * 50_004
    assert peak < read / 10


def test_quality_of_service_of_publishers_is_kept(tmp_path: Path) -> None:
    offers = (OfferedQos(1, "keep_last", "reliable", "transient_local"), OfferedQos(7))
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(bag.add_topic("/c", STRING, offers), 1, b"\0\1\0\0")
    assert Recording.of([tmp_path / "bag"]).topics["/c"].qos == offers
    other = write_rosbags(tmp_path / "other", [("/c", STRING, b"\0\1\0\0")])
    assert Recording.of([other]).topics["/c"].qos == ()


def test_topics_are_named_with_or_without_slash(tmp_path: Path) -> None:
    recording = Recording.of([write_mcap(tmp_path / "log.mcap", random_messages(9))])
    assert [topic.name for topic in recording.find(["b", "/a", "/b"])] == ["/b", "/a"]
    with raises_code("E210", r"/d, .* /a \(sensor_msgs"):
        recording.find(["/d"])


def test_foreign_encoding_is_rejected_when_requested(tmp_path: Path) -> None:
    recording = Recording.of(
        [write_mcap(tmp_path / "log.mcap", random_messages(9), encoding="json")]
    )
    with raises_code("E217", r"/a .* json"):
        recording.require_cdr(recording.topics["/a"])


def test_topic_of_two_types_is_rejected(tmp_path: Path) -> None:
    bags = [
        write_rosbags(tmp_path / kind[:3], [("/a", kind, b"\0\1\0\0")]) for kind in (IMU, STRING)
    ]
    with raises_code("E211", r"/a .* sensor_msgs/msg/Imu .* std_msgs/msg/Str"):
        Recording.of(bags)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "no such bag; give a bag's folder or an .mcap file"),
        (b"", "empty; record it again"),
        (b"no bag at all", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "the recording was interrupted"),
    ],
    ids=["missing", "empty", "other", "cut"],
)
def test_files_that_are_not_bags_are_rejected(
    tmp_path: Path, content: bytes | None, line: str
) -> None:
    file = tmp_path / "log.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(BagError, match=line):
        Recording.of([file])


def test_bag_without_messages_is_rejected(tmp_path: Path) -> None:
    with raises_code("E213"):
        Recording.of([write_mcap(tmp_path / "log.mcap", [])])
    with raises_code("E202"):
        Recording.of([])


def test_flipped_bytes_are_detected_or_harmless(tmp_path: Path) -> None:
    """Payloads with a checksum are correct or rejected, and only BagError is raised."""
    messages = random_messages(60)
    good = write_mcap(tmp_path / "good.mcap", messages, enable_crcs=True).read_bytes()
    draw, refusals = np.random.default_rng(1), []
    for number in range(300):
        damaged = bytearray(good)
        damaged[int(draw.integers(8, len(good) - 8))] ^= int(draw.integers(1, 256))
        file = tmp_path / f"{number}.mcap"
        file.write_bytes(damaged)
        try:
            read = everything(Recording.of([file]))
        except BagError as error:
            refusals.append(str(error))
        else:
            assert {message.payload for message in read} <= {m.payload for m in messages}
    assert len(refusals) > 100
    assert all(line.startswith(str(tmp_path)) and "\n" not in line for line in refusals)
