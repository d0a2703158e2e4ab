"""Write an indexed, chunked MCAP file message by message.

The record types are those of the mcap package. Its ``Writer`` is not used: it takes 20 µs for a
message, five times as long as this one, and after a failed write it accepts messages that never
reach the file.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from symbid_ros.bags.container.mcap_records import (
    INDEX_ENTRY_SIZE,
    MAGIC,
    MESSAGE,
    RECORD,
    Attachment,
)

FRAME_SIZE = 512  # upper bound for data end, statistics, summary offsets, footer and magic, bytes
STATISTICS_ENTRY = 16  # upper bound for a channel's part of the statistics, bytes
INDEXES = Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX
# In the order of the summary.
GROUPS = Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, *INDEXES


class StoredChunk(NamedTuple):
    """A written chunk: position, times, its index record, and messages by channel."""

    offset: int
    start: int
    end: int
    index_record: bytes
    counts: dict[int, int]


class SummaryBuilder:
    """Collects the summary, which is written at the end of the file.

    Attributes
    ----------
    chunks : list of StoredChunk
        In order.
    size : int
        Upper bound for the size of the encoded summary, bytes.
    """

    def __init__(self) -> None:
        self.chunks: list[StoredChunk] = []
        self.size = FRAME_SIZE
        # Positions in the file, and records, by opcode.
        self._records: dict[int, list[tuple[int, bytes]]] = defaultdict(list)

    @property
    def start(self) -> int:
        """Smallest log time in the file's chunks, nanoseconds; 0 without any."""
        return min((chunk.start for chunk in self.chunks), default=0)

    @property
    def end(self) -> int:
        """Largest log time in the file's chunks, nanoseconds; 0 without any."""
        return max((chunk.end for chunk in self.chunks), default=0)

    def add(self, opcode: int, offset: int, record: McapRecord) -> None:
        """Add a schema, a channel, or the index of the metadata or attachment at ``offset``."""
        encoded = encode(record)
        self._records[opcode].append((offset, encoded))
        self.size += len(encoded) + (STATISTICS_ENTRY if opcode == Opcode.CHANNEL else 0)

    def add_chunk(self, chunk: StoredChunk) -> None:
        """Add a written chunk."""
        self.chunks.append(chunk)
        self.size += len(chunk.index_record)

    def remove_last(self, size: int, end: int) -> list[StoredChunk]:
        """Remove the last chunks and the records after them; return the chunks, last first.

        Parameters
        ----------
        size : int
            Bytes to remove, at least, if the file has as many.
        end : int
            End of the file.
        """
        removed: list[StoredChunk] = []
        cut = end
        while self.chunks and end - cut < size:
            removed.append(self.chunks.pop())
            cut = removed[-1].offset
            self.size -= len(removed[-1].index_record)
        # A channel announced after the cut has no message left, but stays in the summary.
        for opcode in INDEXES:
            self._records[opcode] = [entry for entry in self._records[opcode] if entry[0] < cut]
        return removed

    def encode(self, position: int, counts: dict[int, int]) -> bytes:
        """Return the end of a file whose data section ends at ``position``.

        ``counts`` are the file's messages by channel.
        """
        data_end = encode(DataEnd(data_section_crc=0))
        start = position + len(data_end)
        summary = bytearray()
        offsets = bytearray()
        groups = {opcode: [record for _, record in self._records[opcode]] for opcode in GROUPS}
        groups[Opcode.STATISTICS] = [encode(self._statistics(counts))]
        groups[Opcode.CHUNK_INDEX] = [chunk.index_record for chunk in self.chunks]
        for opcode, records in groups.items():
            if body := b"".join(records):
                offsets += encode(SummaryOffset(opcode, start + len(summary), len(body)))
                summary += body
        footer = Footer(start, start + len(summary), summary_crc=0)
        # The checksum also covers the footer up to itself.
        footer.summary_crc = zlib.crc32(summary + offsets + encode(footer)[:-4])
        return data_end + summary + offsets + encode(footer) + MAGIC

    def _statistics(self, counts: dict[int, int]) -> Statistics:
        return Statistics(
            attachment_count=len(self._records[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(self._records[Opcode.CHANNEL]),
            channel_message_counts=counts,
            chunk_count=len(self.chunks),
            message_count=sum(counts.values()),
            message_start_time=self.start,
            message_end_time=self.end,
            metadata_count=len(self._records[Opcode.METADATA_INDEX]),
            schema_count=len(self._records[Opcode.SCHEMA]),
        )


def encode(record: McapRecord) -> bytes:
    """Return a record as stored in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


# Opcode and length of a record, followed by the fixed fields of its body.
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
INDEX_HEAD = struct.Struct("<BQHI")


class McapWriter:
    """Writes messages in compressed chunks with indexes, summary and checksums.

    After an ``OSError``, an incomplete record can be removed again: `abandon` and
    `remove_last_chunks` leave a file that `finish` can complete.

    Parameters
    ----------
    stream : binary file
        Open for writing, at its start; may write less than requested.
    chunk_size : int
        Bytes of message records after which a chunk is compressed and written.

    Attributes
    ----------
    summary : SummaryBuilder
    """

    def __init__(self, stream: BinaryIO, chunk_size: int) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._position = 0
        self.summary = SummaryBuilder()
        self._schemas: dict[tuple[str, bytes, str], int] = {}
        self._counts: dict[int, int] = {}
        self._open = bytearray()
        self._places: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._write(MAGIC + encode(Header(profile="ros2", library="symbid_ros")))

    @property
    def counts(self) -> dict[int, int]:
        """Messages accepted so far, by channel."""
        return dict(self._counts)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._position

    def add_schema(self, name: str, definition: bytes, encoding: str = "ros2msg") -> int:
        """Return the number of a type's definition, and write it if it is new."""
        key = name, definition, encoding
        if key not in self._schemas:
            number = len(self._schemas) + 1
            schema = Schema(id=number, name=name, encoding=encoding, data=definition)
            self._write(encode(schema))
            self.summary.add(Opcode.SCHEMA, self._position, schema)
            self._schemas[key] = number
        return self._schemas[key]

    def add_channel(
        self, topic: str, schema: int, metadata: dict[str, str], message_encoding: str = "cdr"
    ) -> int:
        """Write a channel and return its number; ``schema`` is 0 for none."""
        channel = Channel(
            id=len(self._counts) + 1,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema,
            metadata=metadata,
        )
        self._write(encode(channel))
        self.summary.add(Opcode.CHANNEL, self._position, channel)
        self._counts[channel.id] = 0
        return channel.id

    def add_message(
        self, channel: int, log_time: int, publish_time: int, payload: bytes, sequence: int = 0
    ) -> None:
        """Append one message to the open chunk; times in nanoseconds."""
        chunk = self._open
        self._places[channel].append((log_time, len(chunk)))
        chunk += MESSAGE_HEAD.pack(
            Opcode.MESSAGE,
            MESSAGE.size + len(payload),
            channel,
            sequence,
            log_time,
            publish_time,
        )
        chunk += payload
        self._counts[channel] += 1
        if len(chunk) > self._chunk_size:
            self.end_chunk()

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Write a metadata record."""
        record = encode(Metadata(name=name, metadata=content))
        index = MetadataIndex(offset=self._position, length=len(record), name=name)
        self._write(record)
        self.summary.add(Opcode.METADATA_INDEX, index.offset, index)

    def add_attachment(self, attachment: Attachment, source: BinaryIO) -> None:
        """Copy an attachment's record from another file."""
        index = attachment.index(self._position)
        self.add_record(attachment.record(source))
        self.summary.add(Opcode.ATTACHMENT_INDEX, index.offset, index)

    def add_record(self, parts: Iterable[bytes]) -> None:
        """Write an encoded record."""
        for part in parts:
            self._write(part)

    def end_chunk(self) -> None:
        """Write the open chunk and its message indexes, unless it is empty."""
        if not self._open:
            return
        raw = bytes(self._open)
        times = [time for entries in self._places.values() for time, _ in entries]
        start, end = min(times), max(times)
        data = self._compressor.compress(raw)
        record = encode(
            Chunk(
                compression="zstd",
                data=data,
                message_start_time=start,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=len(raw),
            )
        )
        indexes = bytearray()
        offsets = {}
        for channel, entries in self._places.items():
            offsets[channel] = self._position + len(record) + len(indexes)
            size = INDEX_ENTRY_SIZE * len(entries)
            length = INDEX_HEAD.size - RECORD.size + size
            indexes += INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, length, channel, size)
            indexes += struct.pack(f"<{2 * len(entries)}Q", *(n for pair in entries for n in pair))
        index = encode(
            ChunkIndex(
                message_start_time=start,
                message_end_time=end,
                chunk_start_offset=self._position,
                chunk_length=len(record),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compression="zstd",
                compressed_size=len(data),
                uncompressed_size=len(raw),
            )
        )
        counts = {channel: len(entries) for channel, entries in self._places.items()}
        chunk = StoredChunk(self._position, start, end, index, counts)
        self._write(record + indexes)
        self.summary.add_chunk(chunk)
        self._open.clear()
        self._places.clear()

    def abandon(self) -> None:
        """Discard the open chunk and what a failed write has left in the file."""
        for channel, entries in self._places.items():
            self._counts[channel] -= len(entries)
        self._open.clear()
        self._places.clear()
        self._cut(self._position)

    def remove_last_chunks(self, size: int) -> bool:
        """Remove the last chunks, at least ``size`` bytes; return False if there is no chunk."""
        removed = self.summary.remove_last(size, self._position)
        if not removed:
            return False
        for chunk in removed:
            for channel, count in chunk.counts.items():
                self._counts[channel] -= count
        self._cut(removed[-1].offset)
        return True

    def finish(self) -> None:
        """Write the last chunk, the summary and the footer; the stream stays open."""
        self.end_chunk()
        # In one step: if the summary does not fit, all of it is removed.
        self._write(self.summary.encode(self._position, self._counts))

    def _write(self, data: bytes | bytearray) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._stream.write(rest) :]
        self._position += len(data)

    def _cut(self, position: int) -> None:
        self._stream.seek(position)
        self._stream.truncate()
        self._position = position
