"""Chunks, attachments and messages in records, on either side of every stated size."""

import io
import struct
import zlib

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode

from symbid_ros.bags.container import mcap_records
from symbid_ros.bags.container.mcap_records import (
    FOOTER_SIZE,
    MAGIC,
    Attachment,
    ChunkRecord,
    checked_size,
    find_messages,
    identify_other_format,
    read_parts,
)
from symbid_ros.errors import BagError
from symbid_ros.messages.limits import OverLimitError


def record(opcode, body=b""):
    return struct.pack("<BQ", opcode, len(body)) + body


MESSAGE = record(Opcode.MESSAGE, bytes(22) + b"payload")
EMPTY = record(Opcode.MESSAGE, bytes(22))
SCHEMA, CHANNEL = record(Opcode.SCHEMA, b"schema"), record(Opcode.CHANNEL, b"channel")


def test_messages_are_found_among_schemas_and_channels():
    announced = []
    data = SCHEMA + MESSAGE + CHANNEL + EMPTY + MESSAGE
    starts = find_messages(data, lambda opcode, body: announced.append((opcode, bytes(body))))
    first, last = len(SCHEMA), len(data) - len(MESSAGE)
    assert list(starts) == [first, last - len(EMPTY), last]
    assert announced == [(Opcode.SCHEMA, b"schema"), (Opcode.CHANNEL, b"channel")]
    assert list(find_messages(b"", print)) == []


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (MESSAGE[:-1], "extends beyond"),
        (MESSAGE + SCHEMA[:-1], "extends beyond"),
        (record(Opcode.MESSAGE, bytes(21)), "too short"),
        (record(Opcode.METADATA), "kind 12"),
        (record(Opcode.CHUNK), "kind 6"),
    ],
)
def test_other_records_are_rejected(data, fault):
    with pytest.raises(ValueError, match=fault):
        find_messages(data, lambda *_: None)


RAW = MESSAGE * 9
SIZE, CRC = len(RAW), zlib.crc32(RAW)


def chunk(data=RAW, *, size=SIZE, crc=CRC, name=b"", packed=None):
    packed = len(data) if packed is None else packed
    head = struct.pack("<QQQII", 3, 8, size, crc, len(name)) + name
    return head + struct.pack("<Q", packed) + data


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (RAW, b""),
        (zstandard.compress(RAW), b"zstd"),
        (lz4.frame.compress(RAW), b"lz4"),
        (lz4.frame.compress(RAW[:50]) + lz4.frame.compress(RAW[50:]), b"lz4"),
    ],
)
@pytest.mark.parametrize("crc", [0, zlib.crc32(RAW)])
@pytest.mark.parametrize("later", [b"", b"later fields"])
def test_chunks_are_decompressed(data, name, crc, later):
    parsed = ChunkRecord.parse(chunk(data, name=name, crc=crc) + later)
    assert (parsed.start, parsed.end, parsed.size, parsed.crc) == (3, 8, len(RAW), crc)
    assert parsed.compression == name.decode()
    assert bytes(parsed.decompress()) == RAW


@pytest.mark.parametrize("name", [b"zstd", b"lz4", b"", b"unknown"])
def test_an_empty_chunk_needs_no_compressed_data(name):
    assert ChunkRecord.parse(chunk(b"", size=0, crc=0, name=name)).decompress() == b""


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        (chunk(packed=len(RAW) + 1), "size"),
        (chunk(size=len(RAW) - 1), "size"),
        (chunk(size=len(RAW) + 1), "size"),
        (chunk(crc=1), "checksum"),
        (chunk(name=b"x" * 16), "unknown compression 'xxxxxxxxxxxxxxxx'"),
        (chunk(name=b"x" * 17), "does not name"),
        (chunk(lz4.frame.compress(RAW + b"m"), name=b"lz4"), "size"),
        (chunk(lz4.frame.compress(RAW[:-1]), name=b"lz4"), "size"),
    ],
)
def test_chunks_that_contradict_themselves_are_rejected(body, fault):
    with pytest.raises(ValueError, match=fault):
        ChunkRecord.parse(body).decompress()


def test_large_chunks_have_a_limited_compression_ratio(monkeypatch):
    monkeypatch.setattr(mcap_records, "ANY_RATIO_SIZE", len(RAW))
    monkeypatch.setattr(mcap_records, "MAX_EXPANSION", 1)
    squeezed = zstandard.compress(RAW)
    assert len(RAW) > 2 * len(squeezed)
    assert bytes(ChunkRecord.parse(chunk(squeezed, name=b"zstd")).decompress()) == RAW
    monkeypatch.setattr(mcap_records, "ANY_RATIO_SIZE", len(RAW) - 1)
    assert bytes(ChunkRecord.parse(chunk()).decompress()) == RAW
    for data in (squeezed, b""):
        with pytest.raises(OverLimitError, match="ratio"):
            ChunkRecord.parse(chunk(data, name=b"zstd")).decompress()
    monkeypatch.setattr(mcap_records, "MAX_CHUNK", len(RAW) - 1)
    with pytest.raises(OverLimitError, match="chunk"):
        ChunkRecord.parse(chunk()).decompress()


def attachment(content=b"content", *, size=None, crc=None):
    def text(value):
        return struct.pack("<I", len(value)) + value

    body = struct.pack("<QQ", 4, 5) + text(b"name") + text(b"text/plain")
    body += struct.pack("<Q", len(content) if size is None else size) + content
    return record(
        Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body) if crc is None else crc)
    )


@pytest.mark.parametrize("content", [b"", b"content", bytes(range(256)) * 5000])
@pytest.mark.parametrize("crc", [None, 0])
def test_attachments_are_read_where_they_are(content, crc):
    whole = attachment(content, crc=crc)
    stream = io.BytesIO(b"before" + whole + b"after")
    found = Attachment.read(stream, 6, len(whole))
    expected = Attachment(6, len(whole), 4, 5, "name", "text/plain", len(content))
    assert found == expected
    assert b"".join(found.record(stream)) == whole
    index = found.index(77)
    assert (index.offset, index.length, index.log_time, index.create_time) == (77, len(whole), 4, 5)
    assert (index.data_size, index.name, index.media_type) == (len(content), "name", "text/plain")


@pytest.mark.parametrize(
    ("whole", "fault"),
    [(attachment(size=8), "size"), (attachment(crc=1), "checksum"), (attachment(size=99), "size")],
)
def test_attachments_that_contradict_themselves_are_rejected(whole, fault):
    with pytest.raises(ValueError, match=fault):
        Attachment.read(io.BytesIO(whole + bytes(9)), 0, len(whole))


@pytest.mark.parametrize(("offset", "length"), [(0, 9), (3, 4), (2, 0)])
@pytest.mark.parametrize("part", [1, 4, 100])
def test_large_ranges_are_read_in_parts(monkeypatch, offset, length, part):
    monkeypatch.setattr(mcap_records, "MIB", part)
    stream = io.BytesIO(b"123456789")
    parts = list(read_parts(stream, offset, length))
    assert b"".join(parts) == b"123456789"[offset : offset + length]
    assert all(0 < len(each) <= part for each in parts)
    with pytest.raises(ValueError, match="shorter"):
        list(read_parts(stream, 8, 2))


FOOTER = record(Opcode.FOOTER, bytes(20))


def test_a_finished_file_has_a_footer(tmp_path):
    file = tmp_path / "log.mcap"
    assert len(FOOTER) == FOOTER_SIZE
    for middle in (b"", b"data"):
        file.write_bytes(MAGIC + middle + FOOTER + MAGIC)
        assert checked_size(file) == len(MAGIC + middle + FOOTER + MAGIC)
    for content in (
        MAGIC,
        MAGIC + FOOTER,
        MAGIC + FOOTER + MAGIC[:-1],
        MAGIC + b"\x03" + FOOTER[1:] + MAGIC,
        MAGIC + FOOTER + b"x" + MAGIC,
    ):
        file.write_bytes(content)
        with pytest.raises(BagError, match="interrupted"):
            checked_size(file)
    file.write_bytes(b"text of at least one magic")
    with pytest.raises(BagError, match="not an MCAP file"):
        checked_size(file)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"#ROSBAG V2.0\n", "a ROS 1 bag"),
        (b"SQLite format 3\0", "an SQLite file"),
        (zstandard.compress(b"log"), "zstd -d"),
        (lz4.frame.compress(b"log"), "lz4 -d"),
        (b"", "empty"),
    ],
)
def test_other_formats_are_known_by_their_first_bytes(tmp_path, content, says):
    file = tmp_path / "log.mcap"
    file.write_bytes(content)
    assert says in identify_other_format(file)
    file.write_bytes(b"other" + content)
    assert identify_other_format(file) == ""
