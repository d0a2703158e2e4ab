"""Read the serialised messages of an MCAP file in blocks: bytes, and the span of each message.

The readers of mcap and rosbags make a Python object of each message, so the records are parsed
here. A chunk's index tells where its messages begin. It is checked against the bytes; without a
valid index, the records are scanned. Finally the messages are compared with the file's summary.
"""

import logging
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Header
from numpy.typing import NDArray

from symbid_ros.arrays import IntArray
from symbid_ros.bags.container.mcap_records import (
    INDEX_ENTRY_SIZE,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    PAYLOAD_OFFSET,
    PRIVATE,
    RECORD,
    TO_ROS2,
    Buffer,
    ChunkRecord,
    find_messages,
    report_damage,
)
from symbid_ros.bags.container.mcap_summary import (
    DATA_END_SIZE,
    McapSummary,
    read_summary,
    warn_of_count_mismatch,
)
from symbid_ros.bags.container.schema_registry import SchemaRegistry, parse_record
from symbid_ros.errors import BagError
from symbid_ros.messages.layout import ByteArray, gather_rows
from symbid_ros.messages.limits import MAX_CHUNK, MIB, check_limit
from symbid_ros.messages.topics import Topic


@dataclass
class ChunkBatch:
    """Successive chunks that are processed together, and the message positions in their indexes.

    Attributes
    ----------
    size : int
        Stated bytes of all decompressed records.
    chunks, unchecked : int
        Number of chunks, and of those without a checksum.
    """

    size: int = 0
    chunks: int = 0
    unchecked: int = 0
    _parts: list[ChunkRecord | Buffer] = field(default_factory=list)
    _base: int = 0
    _entries: list[Buffer] = field(default_factory=list)
    _bases: list[int] = field(default_factory=list)
    _counts: list[int] = field(default_factory=list)

    def add_message(self, record: Buffer) -> None:
        """Add a message record that is outside of chunks."""
        self._add(record, len(record))

    def add_chunk(self, chunk: ChunkRecord) -> None:
        """Add a chunk, which is decompressed later."""
        self._add(chunk, chunk.size)
        self.chunks += 1
        self.unchecked += not chunk.crc

    def add_index(self, body: Buffer) -> None:
        """Add the body of a message index of the last chunk: channel, size, entries."""
        _, size = INDEX_HEAD.unpack_from(body)
        end = INDEX_HEAD.size + size
        if len(body) < end or size % INDEX_ENTRY_SIZE:
            raise ValueError("a message index is truncated")
        self._entries.append(body[INDEX_HEAD.size : end])
        self._bases.append(self._base)
        self._counts.append(size // INDEX_ENTRY_SIZE)

    def decompress(self) -> Buffer:
        """Return all records; each chunk is checked against its size and checksum."""
        parts = [
            part.decompress() if isinstance(part, ChunkRecord) else part for part in self._parts
        ]
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def starts(self) -> IntArray:
        """Return where messages begin according to the indexes, sorted (N,)."""
        if sum(self._counts) * PAYLOAD_OFFSET > self.size:  # more entries than messages fit in
            return np.empty(0, dtype=np.int64)
        offsets = np.frombuffer(b"".join(self._entries), dtype="<i8")[1::2]
        return np.sort(offsets + np.repeat(np.array(self._bases, dtype=np.int64), self._counts))

    def _add(self, part: ChunkRecord | Buffer, size: int) -> None:
        self._base = self.size
        self._parts.append(part)
        self.size += size


MESSAGE_INDEX = int(Opcode.MESSAGE_INDEX)  # names of enumerations are looked up slowly
HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2")])
BLOCK_SIZE = 4 * MIB  # chunks are joined to blocks, since each block costs time for each topic
EXTENT_SIZE = MIB  # read at once: small reads cost time for each record of small chunks
MAX_HELD = 4 * BLOCK_SIZE  # bytes of extents for a block, of which skipped records may be a part
MAX_READ_AHEAD = 2 * BLOCK_SIZE  # larger blocks are not decompressed ahead, to save memory
SKIPPED = frozenset({Opcode.ATTACHMENT, Opcode.METADATA})
DATA = SKIPPED | {
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
}
CHANNELS = 1 << 16

logger = logging.getLogger("symbid_ros.bags")


@dataclass(frozen=True)
class MessageBlock:
    """Consecutive messages of one file.

    Attributes
    ----------
    data : (B,) uint8
        Bytes of the messages.
    spans : dict of Topic to (N, 2) int64
        Start and length of each payload, in order of recording, for each topic announced so far,
        even without a message.
    """

    data: ByteArray
    spans: dict[Topic, IntArray]


def read_mcap_blocks(file: Path) -> Iterator[MessageBlock]:
    """Yield all messages of an MCAP file, a few megabytes at a time.

    A warning is logged if the file's summary counts other messages than were found.
    """
    with report_damage(file):
        summary = read_summary(file)
        yield from _FileReader(file, summary, summary.registry).blocks()


@dataclass
class _FileReader:
    file: Path
    summary: McapSummary
    registry: SchemaRegistry
    chunks: int = 0
    unchecked: int = 0
    private: int = 0
    counts: IntArray = field(default_factory=lambda: np.zeros(CHANNELS, dtype=np.int64))
    topics: dict[Topic, int] = field(default_factory=dict)
    topic_of: NDArray[np.int16] = field(default_factory=lambda: np.full(CHANNELS, -1, np.int16))

    def blocks(self) -> Iterator[MessageBlock]:
        # Decompression releases the interpreter lock: one block is decompressed in a thread while
        # the caller uses the previous one.
        with ThreadPoolExecutor(1) as executor:
            ahead: tuple[ChunkBatch, Callable[[], Buffer]] | None = None
            for batch in self._batches():
                decompress: Callable[[], Buffer] = batch.decompress
                if batch.size <= MAX_READ_AHEAD:
                    decompress = executor.submit(batch.decompress).result
                if ahead is not None:
                    yield self._block(*ahead)
                ahead = batch, decompress
            if ahead is not None:
                yield self._block(*ahead)
        self._warn()

    def _batches(self) -> Iterator[ChunkBatch]:
        """Yield the chunks of the file, joined to batches of about `BLOCK_SIZE` bytes."""
        batch = ChunkBatch()
        last, held = memoryview(b""), 0
        for opcode, extent, start, stop in self._records():
            if extent is not last:
                last, held = extent, held + len(extent)
            body = extent[start + RECORD.size : stop]
            if opcode == MESSAGE_INDEX:
                batch.add_index(body)
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                chunk = ChunkRecord.parse(body) if opcode == Opcode.CHUNK else None
                size = stop - start if chunk is None else chunk.size
                if batch.size and (batch.size + size > BLOCK_SIZE or held > MAX_HELD):
                    yield batch
                    batch, held = ChunkBatch(), len(extent)
                if chunk is None:
                    batch.add_message(extent[start:stop])
                else:
                    batch.add_chunk(chunk)
            elif opcode == Opcode.HEADER:
                self._check_profile(body)
            else:
                self.registry.add(opcode, body)
        yield batch

    def _records(self) -> Iterator[tuple[int, memoryview, int, int]]:
        """Yield the data section's records, except irrelevant ones.

        These are the opcode, some bytes of the file, and where in them the record starts and stops.
        """
        with self.file.open("rb") as stream:
            end = self.summary.data_end
            before = None
            position = len(MAGIC)
            extent, start = memoryview(b""), 0
            while position < end:
                if len(extent) < start + RECORD.size:
                    extent, start = _read_extent(stream, position), 0
                opcode, length = RECORD.unpack_from(extent, start)
                size = RECORD.size + length
                position += size
                if position > end:
                    raise ValueError("a record is truncated")
                if not opcode == before == MESSAGE_INDEX:  # most records, if chunks are small
                    if opcode == Opcode.DATA_END and position == end:
                        break
                    self._check_order(before, opcode)
                    before = opcode
                    if opcode >= PRIVATE or opcode in SKIPPED:
                        start += size
                        continue
                if len(extent) < start + size:
                    check_limit("a record", length, MAX_CHUNK)
                    extent, start = _read_extent(stream, position - size, size), 0
                yield opcode, extent, start, start + size
                start += size
            else:
                raise ValueError("its data section does not end where its footer says")
        if self.summary.data_crc:
            self._check_data()

    def _check_data(self) -> None:
        """Compare the data section with its checksum, which few writers give."""
        with self.file.open("rb") as stream:
            left = self.summary.data_end - DATA_END_SIZE
            crc = 0
            while left:
                part = stream.read(min(left, MIB))
                if not part:
                    raise ValueError("it became shorter while it was read")
                crc = zlib.crc32(part, crc)
                left -= len(part)
        if crc != self.summary.data_crc:
            raise ValueError("its data section does not match its checksum")

    def _check_order(self, before: int | None, opcode: int) -> None:
        if (before is None) != (opcode == Opcode.HEADER):
            raise ValueError("its header is not the first record")
        if opcode == Opcode.MESSAGE_INDEX and before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            raise ValueError("a message index does not follow a chunk")
        if opcode >= PRIVATE:
            self.private += 1
        elif opcode not in DATA:
            raise ValueError(f"a record with opcode {opcode} is in its data section")

    def _check_profile(self, body: Buffer) -> None:
        if parse_record(Header.read, body).profile == "ros1":
            raise BagError(
                f"{self.file}: a ROS 1 recording; convert the .bag that it was made from with "
                f"`rosbags-convert {TO_ROS2}`",
                "E204",
            )

    def _block(self, batch: ChunkBatch, decompress: Callable[[], Buffer]) -> MessageBlock:
        data, starts = decompress(), batch.starts()
        content = np.frombuffer(data, dtype=np.uint8)
        heads = _message_heads(content, starts)
        if heads is None or not _is_complete(heads, starts, len(data)):
            starts = np.frombuffer(find_messages(data, self.registry.add), dtype=np.int64)
            heads = _message_heads(content, starts)
            assert heads is not None
        self.chunks += batch.chunks
        self.unchecked += batch.unchecked
        spans = np.stack(
            [starts + PAYLOAD_OFFSET, heads["length"].astype(np.int64) - MESSAGE.size], 1
        )
        return MessageBlock(content, self._by_topic(heads["channel"], spans))

    def _by_topic(self, channels: NDArray[np.uint16], spans: IntArray) -> dict[Topic, IntArray]:
        """Sort spans (N, 2) by topic; a topic may have several channels."""
        for channel in self.registry.channels.values():
            if self.topic_of[channel.id] < 0:
                topic = self.registry.topic(channel)
                self.topic_of[channel.id] = self.topics.setdefault(topic, len(self.topics))
        numbers = self.topic_of[channels]
        if (numbers < 0).any():
            raise ValueError("a message's channel was never announced")
        found = np.bincount(channels)
        self.counts[: len(found)] += found
        ordered = spans[np.argsort(numbers, kind="stable")]
        ends = np.cumsum(np.bincount(numbers, minlength=len(self.topics)))
        return dict(zip(self.topics, np.split(ordered, ends), strict=False))  # the last is empty

    def _warn(self) -> None:
        """Warn of private records, missing checksums and a summary that counts other messages."""
        if self.private:
            logger.warning("%s: %d private records skipped", self.file, self.private)
        if 0 < self.unchecked < self.chunks:
            logger.warning(
                "%s: %d of %d chunks have no checksum", self.file, self.unchecked, self.chunks
            )
        found = {int(channel): int(self.counts[channel]) for channel in np.flatnonzero(self.counts)}
        warn_of_count_mismatch(self.file, self.summary.statistics, found)


def _read_extent(stream: BinaryIO, position: int, size: int = 0) -> memoryview:
    """Return ``size`` or `EXTENT_SIZE` bytes, whichever are more, or fewer at the file's end."""
    stream.seek(position)
    return memoryview(stream.read(max(size, EXTENT_SIZE)))


def _message_heads(data: ByteArray, starts: IntArray) -> NDArray[np.void] | None:
    """Return (N,) opcode, length and channel of the records at ``starts``, if all are inside."""
    if len(starts) and not 0 <= starts[0] <= starts[-1] <= len(data) - PAYLOAD_OFFSET:
        return None
    heads: NDArray[np.void] = gather_rows(data, starts, HEAD.itemsize).view(HEAD)[:, 0]
    return heads


def _is_complete(heads: NDArray[np.void], starts: IntArray, size: int) -> bool:
    """Return whether messages (N,) fill all ``size`` bytes without gaps.

    Only then is the index trusted.
    """
    ends = starts + RECORD.size + heads["length"].astype(np.int64)
    is_gapless = np.array_equal(np.append(starts, size), np.append(0, ends))
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE.size)
    return is_gapless and bool(is_message.all())
