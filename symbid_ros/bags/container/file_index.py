"""The index of a bag's file: where its messages are, so that they can be read in order of time.

The index of an MCAP file comes from its summary if that covers each message, else from its data.
mcap's ``SeekingReader`` trusts any index, and misses messages outside of chunks.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from symbid_ros.bags.container.mcap_records import (
    INDEX_ENTRY_SIZE,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    RECORD,
    Buffer,
    ChunkRecord,
    report_damage,
)
from symbid_ros.bags.container.mcap_summary import McapSummary, read_summary
from symbid_ros.bags.container.schema_registry import SchemaRegistry, full_type_name
from symbid_ros.messages.limits import MAX_CHUNK, MAX_EXTENTS, check_limit, decompress_message
from symbid_ros.messages.topics import OfferedQos

EXTENT_SIZE = 1 << 20  # bytes of messages outside of chunks that are read together


@dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag."""

    name: str
    msgtype: str
    encoding: str  # of its messages; ROS 2 uses cdr
    qos: tuple[OfferedQos, ...]  # offered by its publishers; empty if unknown


class Extent(NamedTuple):
    """Consecutive records of a file that hold messages, such as a chunk."""

    start: int  # first log time, nanoseconds
    end: int  # last log time, nanoseconds
    offset: int  # bytes of an MCAP file, or rows of an SQLite table
    length: int


class StoredMessage(NamedTuple):
    """A message in a file: log time in nanoseconds, channel, serialised message."""

    log_time: int
    channel: int
    payload: bytes


@dataclass(frozen=True)
class FileIndex:
    """The topics of a file and the positions of its messages."""

    file: Path
    topics: Mapping[int, RecordedTopic]  # by channel
    extents: tuple[Extent, ...]  # unsorted; their times may overlap
    statistics: Statistics | None  # message counts stated by the file
    messages: Callable[[Extent], list[StoredMessage]]  # in order of recording


def list_topics(registry: SchemaRegistry) -> dict[int, RecordedTopic]:
    """Return the topics of a file by channel."""
    return {
        number: RecordedTopic(
            name=channel.topic,
            msgtype=full_type_name(schema.name) if (schema := registry.schema(channel)) else "",
            encoding=channel.message_encoding,
            qos=registry.offered_qos(channel),
        )
        for number, channel in registry.channels.items()
    }


INDEX_RECORD = RECORD.size + INDEX_HEAD.size  # bytes of a message index without entries


def read_mcap_index(file: Path) -> FileIndex:
    """Return the index of an MCAP file.

    A summary that does not account for every message is ignored, and the whole file is read
    once. This happens if messages are outside chunks, a chunk has no message index, or the times
    of the chunks contradict the statistics.
    """
    with report_damage(file):
        summary = read_summary(file, with_chunks=True)
        if not _is_complete(summary):
            return _FileScan(file, summary).index()
        extents = tuple(
            Extent(
                chunk.message_start_time,
                chunk.message_end_time,
                chunk.chunk_start_offset,
                chunk.chunk_length,
            )
            for chunk in summary.chunks
            if _indexed(chunk)
        )
        if any(extent.offset + extent.length > summary.data_end for extent in extents):
            raise ValueError("its index points beyond the file's end")
        if len({extent.offset for extent in extents}) < len(extents):
            raise ValueError("its index lists a chunk twice")
        return _file_index(file, summary.registry, extents, summary.statistics)


def _is_complete(summary: McapSummary) -> bool:
    """Return whether a summary lists all channels and its chunk indexes cover all messages."""
    stated = summary.statistics
    if (
        stated is None
        or stated.channel_count != len(summary.registry.channels)
        or stated.chunk_count != len(summary.chunks)
        or stated.message_count != sum(map(_indexed, summary.chunks))
    ):
        return False
    filled = [chunk for chunk in summary.chunks if _indexed(chunk)]
    starts = [chunk.message_start_time for chunk in filled]
    ends = [chunk.message_end_time for chunk in filled]
    return not filled or (
        all(start <= end for start, end in zip(starts, ends, strict=True))
        and (min(starts), max(ends)) == (stated.message_start_time, stated.message_end_time)
    )


def _indexed(chunk: ChunkIndex) -> float:
    """Return how many messages of a chunk are in its message indexes.

    The result is not an integer if they have fields of a later version of the format.
    """
    frames = INDEX_RECORD * len(chunk.message_index_offsets)
    return float(chunk.message_index_length - frames) / INDEX_ENTRY_SIZE


def _file_index(
    file: Path,
    registry: SchemaRegistry,
    extents: tuple[Extent, ...],
    statistics: Statistics | None,
) -> FileIndex:
    topics = list_topics(registry)

    def messages(extent: Extent) -> list[StoredMessage]:
        with report_damage(file):
            with file.open("rb") as stream:
                stream.seek(extent.offset)
                data = stream.read(check_limit("a chunk", extent.length, MAX_CHUNK))
            found = [
                _message(records, start, stop)
                for opcode, start, stop, records in _records(data)
                if opcode == Opcode.MESSAGE
            ]
            if not topics.keys() >= {message.channel for message in found}:
                raise ValueError("a message's channel was never announced")
            if not all(extent.start <= message.log_time <= extent.end for message in found):
                raise ValueError("a chunk's times are not what its index says")
        return found

    return FileIndex(file, topics, extents, statistics, messages)


@dataclass
class _FileScan:
    """Builds the index by reading a whole file without keeping messages."""

    file: Path
    summary: McapSummary
    registry: SchemaRegistry = field(default_factory=SchemaRegistry)
    extents: list[Extent] = field(default_factory=list)

    def index(self) -> FileIndex:
        end = self.summary.data_end
        with self.file.open("rb") as stream:
            stream.seek(len(MAGIC))
            while (offset := stream.tell()) < end:
                head = stream.read(RECORD.size)
                opcode, length = RECORD.unpack(head)
                if offset + RECORD.size + length > end:
                    raise ValueError("a record is truncated")
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                    body = stream.read(check_limit("a record", length, MAX_CHUNK))
                    self._add(offset, head + body)
                else:
                    stream.seek(length, 1)
        return _file_index(self.file, self.registry, tuple(self.extents), self.summary.statistics)

    def _add(self, offset: int, record: bytes) -> None:
        times = []
        for opcode, start, stop, data in _records(record):
            if opcode == Opcode.MESSAGE:
                times.append(_message(data, start, stop).log_time)
            else:
                self.registry.add(opcode, data[start:stop])
        if times:
            self._extend(Extent(min(times), max(times), offset, len(record)))

    def _extend(self, extent: Extent) -> None:
        """Add an extent, joined to the previous one if both are small and adjacent."""
        if self.extents:
            last = self.extents[-1]
            length = last.length + extent.length
            if last.offset + last.length == extent.offset and length <= EXTENT_SIZE:
                self.extents[-1] = Extent(
                    min(last.start, extent.start), max(last.end, extent.end), last.offset, length
                )
                return
        self.extents.append(extent)
        check_limit("a number of chunks", len(self.extents), MAX_EXTENTS)


def _records(data: Buffer, *, inside: bool = False) -> Iterator[tuple[int, int, int, Buffer]]:
    """Yield opcode, beginning and end of each record's body, and the bytes that hold it.

    In place of a chunk, the records in it are yielded; chunks cannot be nested.
    """
    position, end = 0, len(data)
    while position < end:
        opcode, length = RECORD.unpack_from(data, position)
        start = position + RECORD.size
        position = start + length
        if position > end:
            raise ValueError("a record extends beyond its chunk")
        if opcode != Opcode.CHUNK:
            yield opcode, start, position, data
        elif inside:
            raise ValueError(f"a record of kind {opcode} is in a chunk")
        else:
            chunk = ChunkRecord.parse(memoryview(data)[start:position])
            yield from _records(chunk.decompress(), inside=True)


def _message(data: Buffer, start: int, stop: int) -> StoredMessage:
    """Return the message whose record has its body from ``start`` to ``stop``."""
    body = start + MESSAGE.size
    if body > stop:
        raise ValueError("a message record is too short")
    channel, _, log_time, _ = MESSAGE.unpack_from(data, start)
    return StoredMessage(log_time, channel, decompress_message(bytes(data[body:stop]), MAX_CHUNK))
