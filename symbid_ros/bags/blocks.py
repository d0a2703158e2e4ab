"""Serialised messages of a bag, many at a time: bytes and where each message lies in them.

The framing of records is followed here because every general reader makes a
Python object of each message. A chunk's index tells where its messages begin;
it is checked against the bytes, and without a good one the records are walked
through. Schemas, channels and chunks are parsed by the mcap package.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from numpy.typing import NDArray

from symbid_ros.arrays import IntArray
from symbid_ros.bags.layout import ByteArray
from symbid_ros.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
PAYLOAD = RECORD.size + MESSAGE.size
HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2")])
NOTHING = np.empty(0, dtype=np.int64)
BLOCK_SIZE = 4 << 20  # chunks are joined to this many bytes: per-block work is per-topic work
FOOTER_SIZE = RECORD.size + 20


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: name as recorded, message type."""

    name: str
    msgtype: str


@dataclass(frozen=True)
class Block:
    """Consecutive messages of one file.

    Attributes
    ----------
    data : (B,) uint8
        The bytes they lie in.
    spans : dict of Topic to (N, 2) int64
        Start and length of each payload, in order of recording; every topic
        announced so far, those without a message here included.
    """

    data: ByteArray
    spans: dict[Topic, IntArray]


def iterate_blocks(file: Path) -> Iterator[Block]:
    """Yield all messages of an MCAP file, a few megabytes at a time."""
    reader = _FileReader(file)
    try:
        yield from reader.blocks()
    except (
        struct.error,
        ValueError,
        McapError,
        zstandard.ZstdError,
        RuntimeError,  # lz4's
    ) as error:
        detail = str(error) or "it ends early"
        raise BagError(
            f"{file}: damaged MCAP file: {detail}; take another copy or recover it"
        ) from error
    except OSError as error:
        raise BagError(f"{file}: cannot read: {error.strerror}") from error


@dataclass
class _Pending:
    """Chunks waiting to become a block, and where their indexes say messages begin."""

    parts: list[bytes] = field(default_factory=list)
    starts: list[IntArray] = field(default_factory=list)
    size: int = 0
    base: int = 0

    def add(self, part: bytes) -> None:
        self.base = self.size
        self.parts.append(part)
        self.size += len(part)

    def add_index(self, body: bytes) -> None:
        """Take a MessageIndex record: channel, byte count, then pairs of time and offset."""
        pairs = np.frombuffer(body, dtype="<u8", offset=6).reshape(-1, 2)
        self.starts.append(pairs[:, 1].astype(np.int64) + self.base)


@dataclass
class _FileReader:
    file: Path
    schemas: dict[int, str] = field(default_factory=dict)
    topics: dict[int, Topic] = field(default_factory=dict)

    def blocks(self) -> Iterator[Block]:
        with self.file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise BagError(f"{self.file}: not an MCAP file; give a bag's folder or .mcap file")
            end = self._check_footer()
            pending = _Pending()
            while len(head := stream.read(RECORD.size)) == RECORD.size:
                opcode, length = RECORD.unpack(head)
                if opcode == Opcode.DATA_END:
                    break
                if opcode == Opcode.CHUNK and pending.size >= BLOCK_SIZE:
                    yield self._block(pending)
                    pending = _Pending()
                if length > end - stream.tell():
                    raise ValueError("a record is cut short")
                body = stream.read(length)
                if opcode == Opcode.CHUNK:
                    pending.add(_decompressed(body))
                elif opcode == Opcode.MESSAGE_INDEX:
                    pending.add_index(body)
                elif opcode == Opcode.MESSAGE:
                    pending.add(head + body)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._announce(opcode, body)
            yield self._block(pending)

    def _check_footer(self) -> int:
        """Return the file's size."""
        with self.file.open("rb") as stream:
            end = stream.seek(0, 2)
            stream.seek(max(0, end - FOOTER_SIZE - len(MAGIC)))
            ending = stream.read()
        if ending[-len(MAGIC) :] != MAGIC or ending[0] != Opcode.FOOTER:
            raise BagError(
                f"{self.file}: the recording was interrupted, the file has no footer; "
                "record it again or recover it"
            )
        return end

    def _block(self, pending: _Pending) -> Block:
        data = b"".join(pending.parts)
        array = np.frombuffer(data, dtype=np.uint8)
        starts = np.sort(np.concatenate([NOTHING, *pending.starts]))
        if not _is_complete(array, starts):
            starts = self._walk(data)
        heads = _message_heads(array, starts)
        spans = np.stack([starts + PAYLOAD, heads["length"].astype(np.int64) - MESSAGE.size], 1)
        by_topic: dict[Topic, IntArray] = dict.fromkeys(self.topics.values(), spans[:0])
        for topic in by_topic:
            channels = [channel for channel, known in self.topics.items() if known == topic]
            by_topic[topic] = spans[np.isin(heads["channel"], channels)]
        if sum(map(len, by_topic.values())) != len(spans):
            raise ValueError("a message's channel was never announced")
        return Block(array, by_topic)

    def _walk(self, data: bytes) -> IntArray:
        """Return where messages begin, record by record, and learn announced channels."""
        starts = []
        position, end = 0, len(data)
        unpack = RECORD.unpack_from
        while position < end:
            opcode, length = unpack(data, position)
            following = position + RECORD.size + length
            if following > end:
                raise ValueError("a record reaches beyond its chunk")
            if opcode == Opcode.MESSAGE:
                if length < MESSAGE.size:
                    raise ValueError("a message record is too short")
                starts.append(position)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(opcode, data[position + RECORD.size : following])
            position = following
        return np.array(starts, dtype=np.int64)

    def _announce(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema.name
            return
        channel = Channel.read(stream)
        self.topics[channel.id] = Topic(channel.topic, self.schemas.get(channel.schema_id, ""))


def _message_heads(data: ByteArray, starts: IntArray) -> NDArray[np.void]:
    """Return (N,) opcode, length and channel of the records that begin at ``starts``."""
    rows = data[starts[:, None] + np.arange(HEAD.itemsize)]
    heads: NDArray[np.void] = rows.view(HEAD)[:, 0]
    return heads


def _is_complete(data: ByteArray, starts: IntArray) -> bool:
    """Tell whether the messages at ``starts`` follow each other from first to last byte.

    An index is believed only if they do.
    """
    if len(starts) and not 0 <= starts[0] <= starts[-1] <= len(data) - PAYLOAD:
        return False
    heads = _message_heads(data, starts)
    ends = starts + RECORD.size + heads["length"].astype(np.int64)
    is_gapless = np.array_equal(np.append(starts, len(data)), np.append(0, ends))
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE.size)
    return is_gapless and bool(is_message.all())


def _decompressed(body: bytes) -> bytes:
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    if chunk.compression == "zstd":
        # The frame's own size wins over max_output_size: it is checked first.
        if zstandard.frame_content_size(chunk.data) not in (-1, chunk.uncompressed_size):
            raise ValueError("a chunk's size is not what its record says")
        data = zstandard.decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        data = lz4.frame.decompress(chunk.data)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk's size is not what its record says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk does not match its checksum")
    return data
