"""Serialised messages of a bag, many at a time: bytes and where each message lies in them.

The framing of records is followed here because every general reader makes a
Python object of each message. A chunk's index tells where its messages begin;
it is checked against the bytes, and without a good one the records are walked
through. What the file's summary says is held against what was read.
"""

import logging
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

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
    """Chunks as they lie in the file, and where their indexes say messages begin.

    Attributes
    ----------
    size : int
        Bytes of all records inside, as the chunks state them.
    chunks, unchecked : int
        Number of chunks, and of those without a checksum.
    """

    size: int = 0
    chunks: int = 0
    unchecked: int = 0
    _parts: list[ChunkRecord | bytes] = field(default_factory=list)
    _base: int = 0
    _entries: list[bytes] = field(default_factory=list)
    _places: list[tuple[int, int]] = field(default_factory=list)

    def add_message(self, record: bytes) -> None:
        """Take a message's record, which lies in no chunk."""
        self._add(record, len(record))

    def add_chunk(self, chunk: ChunkRecord) -> None:
        """Take a chunk; it is unpacked later."""
        self._add(chunk, chunk.size)
        self.chunks += 1
        self.unchecked += not chunk.crc

    def add_index(self, body: bytes) -> None:
        """Take the body of a message index of the last chunk: channel, size, entries."""
        _, size = INDEX_HEAD.unpack_from(body)
        entries = body[INDEX_HEAD.size : INDEX_HEAD.size + size]
        if len(entries) < size or size % INDEX_ENTRY_SIZE:
            raise ValueError("a message index is cut short")
        self._entries.append(entries)
        self._places.append((self._base, size // INDEX_ENTRY_SIZE))

    def unpacked(self) -> Buffer:
        """Return all records, checked chunk by chunk against size and checksum."""
        parts = [part if isinstance(part, bytes) else part.records() for part in self._parts]
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def starts(self) -> IntArray:
        """Return where messages begin according to the indexes, in increasing order (N,)."""
        count = sum(count for _, count in self._places)
        if count * PAYLOAD_OFFSET > self.size:  # more entries than there is room for messages
            return np.empty(0, dtype=np.int64)
        entries = np.frombuffer(b"".join(self._entries), dtype="<i8").reshape(-1, 2)
        bases, counts = np.array(self._places, dtype=np.int64).reshape(-1, 2).T
        return np.sort(entries[:, 1] + np.repeat(bases, counts))

    def _add(self, part: ChunkRecord | bytes, size: int) -> None:
        self._base = self.size
        self._parts.append(part)
        self.size += size


HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2")])
BLOCK_SIZE = 4 * MIB  # chunks are joined to this many bytes: per-block work is per-topic work
MOST_AHEAD = 2 * BLOCK_SIZE  # what is larger is unpacked when it is wanted: no memory for two
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
        The bytes they lie in.
    spans : dict of Topic to (N, 2) int64
        Start and length of each payload, in order of recording; every topic
        announced so far, those without a message here included.
    chunks, unchecked_chunks : int
        Chunks they were in, and those of them that carry no checksum.
    """

    data: ByteArray
    spans: dict[Topic, IntArray]
    chunks: int = 0
    unchecked_chunks: int = 0


def read_mcap_blocks(file: Path) -> Iterator[MessageBlock]:
    """Yield all messages of an MCAP file, a few megabytes at a time.

    A warning tells where the file's summary counts other messages than were found.
    """
    with report_damage(file):
        summary = read_summary(file)
        yield from _FileReader(file, summary, summary.catalogue).blocks()


@dataclass
class _FileReader:
    file: Path
    summary: McapSummary
    catalogue: SchemaRegistry
    chunks: int = 0
    unchecked: int = 0
    private: int = 0
    counts: IntArray = field(default_factory=lambda: np.zeros(CHANNELS, dtype=np.int64))
    topics: dict[Topic, int] = field(default_factory=dict)
    topic_of: NDArray[np.int16] = field(default_factory=lambda: np.full(CHANNELS, -1, np.int16))

    def blocks(self) -> Iterator[MessageBlock]:
        # Unpacking lets others run meanwhile: it goes on while the block before is made use of.
        with ThreadPoolExecutor(1) as unpacker:
            ahead: tuple[ChunkBatch, Callable[[], Buffer]] | None = None
            for batch in self._batches():
                unpacked: Callable[[], Buffer] = batch.unpacked
                if batch.size <= MOST_AHEAD:
                    unpacked = unpacker.submit(batch.unpacked).result
                if ahead is not None:
                    yield self._block(*ahead)
                ahead = batch, unpacked
            if ahead is not None:
                yield self._block(*ahead)
        self._compare()

    def _batches(self) -> Iterator[ChunkBatch]:
        """Yield the chunks of the file, joined to as much as is worked on at once."""
        batch = ChunkBatch()
        for opcode, body in self._records():
            if opcode == Opcode.MESSAGE_INDEX:
                batch.add_index(body)
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                chunk = ChunkRecord.of(body) if opcode == Opcode.CHUNK else None
                size = RECORD.size + len(body) if chunk is None else chunk.size
                if batch.size and batch.size + size > BLOCK_SIZE:
                    yield batch
                    batch = ChunkBatch()
                if chunk is None:
                    batch.add_message(RECORD.pack(opcode, len(body)) + body)
                else:
                    batch.add_chunk(chunk)
            else:
                self.catalogue.add(opcode, body)
        yield batch

    def _records(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and body of the data's records, but for those that hold no message."""
        with self.file.open("rb") as stream:
            end = self.summary.data_end
            stream.seek(len(MAGIC))
            before = None
            position = len(MAGIC)
            while position < end:
                opcode, length = RECORD.unpack(stream.read(RECORD.size))
                position += RECORD.size + length
                if position > end:
                    raise ValueError("a record is cut short")
                if opcode == Opcode.DATA_END and position == end:
                    break
                self._check_order(before, opcode)
                before = opcode
                if opcode >= PRIVATE or opcode in SKIPPED:
                    stream.seek(length, 1)
                    continue
                body = stream.read(check_limit("a record", length, MAX_CHUNK))
                if opcode == Opcode.HEADER:
                    self._check_profile(body)
                else:
                    yield opcode, body
            else:
                raise ValueError("its data do not end where its footer says")
        if self.summary.data_crc:
            self._check_data()

    def _check_data(self) -> None:
        """Hold all data against their checksum; few writers give one, it covers skipped bytes."""
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
            raise ValueError("its data do not match their checksum")

    def _check_order(self, before: int | None, opcode: int) -> None:
        if (before is None) != (opcode == Opcode.HEADER):
            raise ValueError("its header is not where it belongs")
        if opcode == Opcode.MESSAGE_INDEX and before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            raise ValueError("a message index follows no chunk")
        if opcode >= PRIVATE:
            self.private += 1
        elif opcode not in DATA:
            raise ValueError(f"a record of kind {opcode} is among its data")

    def _check_profile(self, body: bytes) -> None:
        if parse_record(Header.read, body).profile == "ros1":
            raise BagError(
                f"{self.file}: a recording of ROS 1; convert the .bag that it was made from with "
                f"`rosbags-convert {TO_ROS2}`"
            )

    def _block(self, batch: ChunkBatch, unpacked: Callable[[], Buffer]) -> MessageBlock:
        data, starts = unpacked(), batch.starts()
        content = np.frombuffer(data, dtype=np.uint8)
        heads = _message_heads(content, starts)
        if heads is None or not _is_complete(heads, starts, len(data)):
            starts = np.frombuffer(find_messages(data, self.catalogue.add), dtype=np.int64)
            heads = _message_heads(content, starts)
            assert heads is not None
        self.chunks += batch.chunks
        self.unchecked += batch.unchecked
        spans = np.stack(
            [starts + PAYLOAD_OFFSET, heads["length"].astype(np.int64) - MESSAGE.size], 1
        )
        return MessageBlock(
            content,
            self._by_topic(heads["channel"], spans),
            batch.chunks,
            batch.unchecked,
        )

    def _by_topic(self, channels: NDArray[np.uint16], spans: IntArray) -> dict[Topic, IntArray]:
        """Sort spans (N, 2) by topic; two channels may serve one."""
        for channel in self.catalogue.channels.values():
            if self.topic_of[channel.id] < 0:
                topic = Topic(channel.topic, self.catalogue.msgtype(channel))
                self.topic_of[channel.id] = self.topics.setdefault(topic, len(self.topics))
        numbers = self.topic_of[channels]
        if (numbers < 0).any():
            raise ValueError("a message's channel was never announced")
        found = np.bincount(channels)
        self.counts[: len(found)] += found
        ordered = spans[np.argsort(numbers, kind="stable")]
        ends = np.cumsum(np.bincount(numbers, minlength=len(self.topics)))
        return dict(zip(self.topics, np.split(ordered, ends), strict=False))  # nothing is last

    def _compare(self) -> None:
        """Say what the summary counts that was not found, or the other way round."""
        if self.private:
            logger.warning("%s: %d records of private kinds passed over", self.file, self.private)
        if 0 < self.unchecked < self.chunks:
            logger.warning(
                "%s: %d of %d chunks carry no checksum", self.file, self.unchecked, self.chunks
            )
        found = {int(channel): int(self.counts[channel]) for channel in np.flatnonzero(self.counts)}
        warn_of_count_mismatch(self.file, self.summary.statistics, found)


def _message_heads(data: ByteArray, starts: IntArray) -> NDArray[np.void] | None:
    """Return (N,) opcode, length and channel of the records at ``starts``, if they lie inside."""
    if len(starts) and not 0 <= starts[0] <= starts[-1] <= len(data) - PAYLOAD_OFFSET:
        return None
    heads: NDArray[np.void] = gather_rows(data, starts, HEAD.itemsize).view(HEAD)[:, 0]
    return heads


def _is_complete(heads: NDArray[np.void], starts: IntArray, size: int) -> bool:
    """Tell whether messages (N,) follow each other from the first to the last of ``size`` bytes.

    An index is believed only if they do.
    """
    ends = starts + RECORD.size + heads["length"].astype(np.int64)
    is_gapless = np.array_equal(np.append(starts, size), np.append(0, ends))
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= MESSAGE.size)
    return is_gapless and bool(is_message.all())
