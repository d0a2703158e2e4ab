"""Sizes stated by a bag are checked against limits, whichever program wrote it."""

import os
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from expected_errors import raises_code
from foreign_bags import STORE, imu, joint_state, joints_only, write_rosbags
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Schema
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from symbid_ros.bags import Recording, bag_info, read_streams, recover
from symbid_ros.bags.container.blocks import read_mcap_blocks
from symbid_ros.errors import BagError, DataError
from symbid_ros.messages.limits import MAX_CHUNK, MAX_MESSAGE, MAX_NAMES, MIB
from symbid_ros.messages.types import IMU, JOINT_STATE

MAGIC = b"\x89MCAP0\r\n"
STATE = joint_state(1, ["hip"], [1.0], [2.0], [3.0])


def encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def announced(topic: str = "/joint_states", msgtype: str = JOINT_STATE, **changes: Any) -> bytes:
    text = STORE.generate_msgdef(msgtype, ros_version=2)[0].encode()
    schema = {"encoding": "ros2msg", "data": text, **changes}
    encoding = schema.pop("message_encoding", "cdr")
    channel = Channel(id=1, topic=topic, message_encoding=encoding, metadata={}, schema_id=1)
    return encoded(Schema(id=1, name=msgtype, **schema)) + encoded(channel)


def message(payload: bytes = STATE, channel: int = 1) -> bytes:
    return encoded(
        Message(channel_id=channel, data=payload, log_time=1, publish_time=1, sequence=0)
    )


def chunk(data: bytes, size: int, compression: str = "zstd", crc: int = 0) -> bytes:
    return encoded(
        Chunk(
            compression=compression,
            data=data,
            message_start_time=1,
            message_end_time=1,
            uncompressed_crc=crc,
            uncompressed_size=size,
        )
    )


def mcap(file: Path, *data: bytes, profile: str = "ros2") -> Path:
    """Write a file of given records without a summary."""
    begin = MAGIC + encoded(Header(profile=profile, library="by hand"))
    end = encoded(DataEnd(data_section_crc=0)) + encoded(Footer(0, 0, 0)) + MAGIC
    file.write_bytes(begin + b"".join(data) + end)
    return file


def refusal(bag: Path) -> str:
    with pytest.raises((BagError, DataError)) as caught:
        read_streams([bag])
    line = str(caught.value)
    assert line.startswith(str(bag))
    assert "\n" not in line
    assert "; " in line
    return line


def zeros(size: int, *, with_size: bool, long: bool = False) -> bytes:
    parameters = zstandard.ZstdCompressionParameters(
        window_log=27 if long else 20, write_content_size=with_size
    )
    compressor = zstandard.ZstdCompressor(compression_params=parameters)
    stream = compressor.compressobj(size=size if with_size else -1)
    parts = [stream.compress(bytes(16 * MIB)) for _ in range(size // (16 * MIB))]
    return b"".join(parts) + stream.flush()


LARGE = 256 * MIB
BOMBS: dict[str, Callable[[], tuple[bytes, int, str]]] = {
    "honest": lambda: (zeros(LARGE, with_size=True), LARGE, "zstd"),
    "small-by-its-record": lambda: (zeros(LARGE, with_size=True), 1000, "zstd"),
    "of-unknown-size": lambda: (zeros(LARGE, with_size=False), 1000, "zstd"),
    "within-the-limit": lambda: (zeros(64 * MIB, with_size=True), 64 * MIB, "zstd"),
    "far-sighted": lambda: (zeros(LARGE, with_size=False, long=True), 16 * MIB, "zstd"),
    "many-frames": lambda: (zeros(16 * MIB, with_size=True) * 64, 16 * MIB, "zstd"),
    "lz4": lambda: (lz4.frame.compress(bytes(128 * MIB)), 1000, "lz4"),
    "lz4-with-size": lambda: (lz4.frame.compress(bytes(128 * MIB), store_size=True), 999, "lz4"),
    "lz4-frames": lambda: (lz4.frame.compress(bytes(16 * MIB)) * 16, 16 * MIB, "lz4"),
}
READ_ALL = """
import sys
from pathlib import Path
from symbid_ros.bags import read_streams
from symbid_ros.bags import recover
from symbid_ros.bags import Recording
from symbid_ros.errors import SymbidError
good, *bombs = map(Path, sys.argv[1:])
def peak():  # of this process; what getrusage tells begins with its parent's
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024
read_streams([good])
before = peak()
for bomb in bombs:
    for job in (lambda: read_streams([bomb]), lambda: Recording.of([bomb]), lambda: recover(bomb)):
        try:
            job()
        except SymbidError as error:
            print(error, file=sys.stderr)
        else:
            sys.exit(f"{bomb} was read")
print(peak() - before)
"""


def test_compression_bombs_use_little_memory(tmp_path: Path) -> None:
    good = mcap(tmp_path / "good.mcap", announced(), message())
    bombs = []
    for name, bomb in BOMBS.items():
        data, size, compression = bomb()
        file = tmp_path / f"{name}.mcap"
        bombs.append(mcap(file, announced(), chunk(data, size, compression)))
    ended = subprocess.run(
        [sys.executable, "-c", READ_ALL, good, *bombs],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("\n") == 3 * len(bombs)
    assert int(ended.stdout) < 100


@pytest.mark.parametrize(
    ("data", "compression"),
    [
        (lambda raw: zstandard.compress(raw[:50]) + zstandard.compress(raw[50:]), "zstd"),
        (lambda raw: lz4.frame.compress(raw[:50]) + lz4.frame.compress(raw[50:]), "lz4"),
        (lambda raw: lz4.frame.compress(raw, store_size=True), "lz4"),
        (lambda raw: zstandard.ZstdCompressor(write_content_size=False).compress(raw), "zstd"),
        (lambda raw: raw, ""),
    ],
    ids=["zstd-frames", "lz4-frames", "lz4-size", "zstd-no-size", "plain"],
)
def test_valid_compression_formats_are_read(
    tmp_path: Path, data: Callable[[bytes], bytes], compression: str
) -> None:
    raw = announced() + message()
    file = mcap(tmp_path / "log.mcap", chunk(data(raw), len(raw), compression))
    assert read_streams([file]).joints.effort.tolist() == [[3.0]]


@pytest.mark.parametrize(
    ("data", "compression", "line"),
    [
        (lambda raw: zstandard.compress(raw) + b"more", "zstd", "unused data"),
        (lambda raw: lz4.frame.compress(raw) + lz4.frame.compress(b"more"), "lz4", "a chunk's siz"),
        (lambda raw: zstandard.compress(raw)[:-9], "zstd", "damaged MCAP file"),
        (lambda raw: lz4.frame.compress(raw)[:-9], "lz4", "damaged MCAP file"),
        (lambda raw: raw + b"more", "", "a chunk's size"),
        (lambda raw: raw, "xz", "unknown compression 'xz'"),
        (lambda raw: raw, "x" * 100, "a chunk does not name its compr"),
    ],
    ids=["zstd-tail", "lz4-tail", "zstd-cut", "lz4-cut", "plain-tail", "unknown", "nonsense"],
)
def test_invalid_compression_is_rejected(
    tmp_path: Path, data: Callable[[bytes], bytes], compression: str, line: str
) -> None:
    raw = announced() + message()
    file = mcap(tmp_path / "log.mcap", chunk(data(raw), len(raw), compression))
    assert line in refusal(file)


def test_large_messages_of_other_topics_are_skipped(tmp_path: Path) -> None:
    file = tmp_path / "cloud.mcap"
    cloud = np.random.default_rng(0).bytes(32 * MIB)
    with file.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=16 * MIB, compression=CompressionType.NONE)
        writer.start("ros2")
        text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
        states = writer.register_schema(JOINT_STATE, "ros2msg", text)
        clouds = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"")
        joints = writer.register_channel("/joint_states", "cdr", states)
        points = writer.register_channel("/points", "cdr", clouds)
        for n in range(1, 7):
            writer.add_message(joints, n, joint_state(n, ["hip"], [n], [n], [n]), n)
            if n % 3 == 0:
                writer.add_message(points, n, cloud, n)
        writer.finish()
    assert read_streams([file]).joints.effort[:, 0].tolist() == [1, 2, 3, 4, 5, 6]


NESTED = chunk(message(), len(message()), "")


@pytest.mark.parametrize(
    ("records", "line"),
    [
        ([announced(), struct.pack("<BQ", 5, MAX_CHUNK + 1) + bytes(MAX_CHUNK + 1)], "a record of"),
        ([announced(), message()[:4] + b"\xff" * 5 + message()[9:]], "a record is truncated"),
        ([announced(), b"\x42" + bytes(8), message()], "a record with opcode 66 is in"),
        ([message()], "a message's channel was never announced"),
        ([announced("/a"), announced("/b"), message()], "channel 1 is announced twice, differ"),
        ([announced(), struct.pack("<BQHI", 7, 6, 1, 0), message()], "index does not follow"),
        ([announced(), chunk(NESTED, len(NESTED), "")], "a record of kind 6 is in a chunk"),
        ([announced(), chunk(message()[:-1], len(message()) - 1, "")], "extends beyond its chunk"),
        ([announced(), chunk(message(), len(message()), "", crc=7)], "not match its checksum"),
        ([announced()[:-30], message()], "damaged MCAP file"),
    ],
    ids=[
        "huge-message",
        "long-record",
        "unknown",
        "unannounced",
        "twice",
        "orphan-index",
        "nested",
        "overhang",
        "checksum",
        "cut-channel",
    ],
)
def test_invalid_records_are_rejected(tmp_path: Path, records: list[bytes], line: str) -> None:
    assert line in refusal(mcap(tmp_path / "log.mcap", *records))


def test_too_many_channels_are_rejected(tmp_path: Path) -> None:
    channels = [
        encoded(Channel(id=n, topic=f"/{n}", message_encoding="cdr", metadata={}, schema_id=0))
        for n in range(2, 5000)
    ]
    assert "a number of channels" in refusal(mcap(tmp_path / "log.mcap", announced(), *channels))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"message_encoding": "json"}, r"\(sensor_msgs/msg/JointState encoded as json\)"),
        ({"data": b"float32 position"}, "JointState of another definition"),
        ({"data": b"\xff\xfe"}, "JointState of another definition"),
    ],
    ids=["json", "definition", "no-text"],
)
def test_messages_of_another_encoding_or_definition_are_rejected(
    tmp_path: Path, change: dict[str, Any], line: str
) -> None:
    file = mcap(tmp_path / "log.mcap", announced(**change), message())
    with pytest.raises(BagError, match=line):
        read_streams([file])


LENGTHS = {"frame": 12, "names": 20, "name": 24, "position": 32, "velocity": 44, "effort": 60}


@pytest.mark.parametrize("place", LENGTHS.values(), ids=LENGTHS)
@pytest.mark.parametrize("length", [2**32 - 1, 2**31, 2**28, 100])
def test_lengths_beyond_a_message_are_rejected(tmp_path: Path, place: int, length: int) -> None:
    payload = bytearray(STATE)
    struct.pack_into("<I", payload, place, length)
    assert "message 2 is not a valid" in refusal(
        joints_only(tmp_path / "log", STATE, bytes(payload))
    )


@pytest.mark.parametrize(
    "payload",
    [
        joint_state(1, ["hip"], np.zeros(MAX_MESSAGE // 8)),
        joint_state(1, [f"j{n}" for n in range(MAX_NAMES + 1)]),
    ],
    ids=["long", "many-names"],
)
def test_too_large_sensor_messages_are_rejected(tmp_path: Path, payload: bytes) -> None:
    line = refusal(joints_only(tmp_path / "log", STATE, payload))
    assert "exceeds the limit" in line


def spoiled(file: Path, place: int) -> None:
    image = bytearray(file.read_bytes())
    image[place] ^= 1
    file.write_bytes(image)


def test_summary_is_checked(log: Path) -> None:
    file = log / "log_0.mcap"
    spoiled(file, file.read_bytes().rindex(b"sensor_msgs/msg/Imu"))
    with raises_code("E206", "its summary does not match its checksum"):
        read_streams([file])
    with raises_code("E206", "its summary does not match its checksum"):
        Recording.of([file])


def test_data_section_is_compared_with_its_checksum(tmp_path: Path) -> None:
    file = tmp_path / "log.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream, enable_data_crcs=True)
        writer.start("ros2", "a library")
        text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", text)
        channel = writer.register_channel("/joint_states", "cdr", schema)
        writer.add_message(channel, 1, STATE, 1)
        writer.finish()
    assert read_streams([file]).joints.effort.tolist() == [[3.0]]
    spoiled(file, file.read_bytes().index(b"a library"))
    assert "data section does not match its checksum" in refusal(file)


def test_chunks_without_checksum_beside_others_are_reported(
    log: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    raw = message()
    checked, bare = (chunk(raw, len(raw), "", crc) for crc in (zlib.crc32(raw), 0))
    all_bare = mcap(tmp_path / "bare.mcap", announced(), bare, bare)
    assert [*read_mcap_blocks(log / "log_0.mcap")]
    assert [*read_mcap_blocks(all_bare)]
    assert "checksum" not in caplog.text
    assert [*read_mcap_blocks(mcap(tmp_path / "log.mcap", announced(), checked, bare, bare))]
    assert "2 of 3 chunks have no checksum" in caplog.text


def test_missing_chunk_is_reported(log: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A private record, which readers skip, replaces the chunk."""
    file = log / "log_0.mcap"
    image = bytearray(file.read_bytes())
    position = 8
    while image[position] != 6:
        position += 9 + struct.unpack_from("<Q", image, position + 1)[0]
    end = position + 9 + struct.unpack_from("<Q", image, position + 1)[0]
    while image[end] == 7:
        end += 9 + struct.unpack_from("<Q", image, end + 1)[0]
    struct.pack_into("<BQ", image, position, 0x80, end - position - 9)
    file.write_bytes(image)
    read_streams([file])
    assert "its summary counts 2100 messages, " in caplog.text
    assert f"`symbid bag recover {file}` reports what is lost" in caplog.text
    assert "1 private records skipped" in caplog.text


def test_expanding_metadata_is_rejected(log: Path) -> None:
    bomb = "a: &a [x, x]\n" + "".join(
        f"{name}: &{name} [*{before}, *{before}]\n"
        for before, name in zip("abcdefghijklmnop", "bcdefghijklmnopq", strict=True)
    )
    text = f"{bomb}rosbag2_bagfile_information:\n  relative_file_paths: [*q]\n"
    (log / "metadata.yaml").write_text(text)
    assert "not a rosbag2 metadata file" in refusal(log)


def test_bags_of_other_writers_stay_below_the_limits(tmp_path: Path) -> None:
    bag = write_rosbags(
        tmp_path / "log", [("/joint_states", JOINT_STATE, STATE), ("/imu/data", IMU, imu(1))]
    )
    assert read_streams([bag]).joints.names == ("hip",)


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "metadata.yaml"])
def test_pipe_or_device_in_a_bag_folder_does_not_block(name: str, tmp_path: Path) -> None:
    bag = joints_only(tmp_path / "bag", STATE)
    if name == "metadata.yaml":
        (bag / name).unlink()
        os.mkfifo(bag / name)
        assert bag_info(bag).count == 1  # the file itself has the count, too
        return
    for file in bag.iterdir():
        file.unlink()
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(bag / name)
        for read in (bag_info, recover):
            with raises_code("E201", rf"{name}: "):
                read(bag)
        (bag / name).unlink()
    assert list(tmp_path.iterdir()) == [bag]


@pytest.mark.parametrize("size", [9, 40, 1000])
def test_records_are_read_whole_however_much_is_read_at_once(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    raw = message()
    private = struct.pack("<BQ", 0x90, 3000) + bytes(3000)
    mixed = mcap(
        tmp_path / "log.mcap",
        announced(),
        private,
        raw,
        chunk(zstandard.compress(raw * 2), 2 * len(raw)),
        private,
        raw,
    )

    def payloads() -> list[tuple[str, bytes]]:
        return [
            (topic.name, block.data[start : start + length].tobytes())
            for file in (log / "log_0.mcap", mixed)
            for block in read_mcap_blocks(file)
            for topic, spans in block.spans.items()
            for start, length in spans.tolist()
        ]

    at_once = payloads()
    assert at_once[-4:] == [("/joint_states", STATE)] * 4
    monkeypatch.setattr("symbid_ros.bags.container.blocks.EXTENT_SIZE", size)
    assert payloads() == at_once


def test_skipped_records_between_messages_are_not_kept(tmp_path: Path) -> None:
    private = struct.pack("<BQ", 0x90, MIB) + bytes(MIB)
    file = mcap(tmp_path / "log.mcap", announced(), *([message(), private] * 80))
    tracemalloc.start()
    try:
        counts = [len(spans) for block in read_mcap_blocks(file) for spans in block.spans.values()]
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sum(counts) == 80
    assert peak < 60 * MIB
