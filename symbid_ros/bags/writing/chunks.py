"""An indexed, chunked MCAP file, written message by message.

The record types are the mcap package's. Its ``Writer`` is not used because it
spends some 20 µs on a message, five times what packing one takes, and because
after a failed write it goes on accepting messages that never reach the file.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable
from typing import BinaryIO

import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Header, Metadata, MetadataIndex, Schema

from symbid_ros.bags.container.attachment import Attachment
from symbid_ros.bags.container.framing import MAGIC
from symbid_ros.bags.writing.summary import StoredChunk, Summary, encoded

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
MESSAGE_FIELDS = 2 + 4 + 8 + 8  # channel, sequence, log and publish time
INDEX_HEAD = struct.Struct("<BQHI")


class ChunkWriter:
    """Writes messages in compressed chunks with index, summary and checksums.

    Every record reaches the stream whole or, after an ``OSError``, can be cut off again:
    `abandon` and `take_back` leave a file that `finish` can complete.

    Parameters
    ----------
    stream : binary file
        Open for writing, at its start; may write less than it is given.
    chunk_size : int
        Bytes of message records after which a chunk is compressed and written.
    """

    def __init__(self, stream: BinaryIO, chunk_size: int) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._position = 0
        self._summary = Summary()
        self._counts: dict[int, int] = {}
        self._open = bytearray()
        self._places: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._write(MAGIC + encoded(Header(profile="ros2", library="symbid_ros")))

    @property
    def counts(self) -> dict[int, int]:
        """Messages accepted so far, by channel."""
        return dict(self._counts)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._position

    @property
    def summary_size(self) -> int:
        """Bytes, at most, that `finish` has to write for what lies in the file."""
        return self._summary.size

    @property
    def start(self) -> int:
        """Smallest log time in the file's chunks, nanoseconds; 0 without any."""
        return self._summary.start

    @property
    def end(self) -> int:
        """Largest log time in the file's chunks, nanoseconds; 0 without any."""
        return self._summary.end

    def add_schema(self, name: str, definition: bytes, encoding: str = "ros2msg") -> int:
        """Return the number of a type's definition, written if it is new."""
        for known in self._summary.schemas:
            if (known.name, known.data, known.encoding) == (name, definition, encoding):
                return known.id
        schema = Schema(
            id=len(self._summary.schemas) + 1, name=name, encoding=encoding, data=definition
        )
        self._write(encoded(schema))
        self._summary.add_schema(schema)
        return schema.id

    def add_channel(
        self, topic: str, schema: int, metadata: dict[str, str], message_encoding: str = "cdr"
    ) -> int:
        """Write a channel and return its number; a ``schema`` of 0 is none."""
        channel = Channel(
            id=len(self._summary.channels) + 1,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema,
            metadata=metadata,
        )
        self._write(encoded(channel))
        self._summary.add_channel(channel)
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
            MESSAGE_FIELDS + len(payload),
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
        record = encoded(Metadata(name=name, metadata=content))
        place = MetadataIndex(offset=self._position, length=len(record), name=name)
        self._write(record)
        self._summary.add_metadata(place)

    def add_attachment(self, attachment: Attachment, source: BinaryIO) -> None:
        """Copy an attachment's record from the file in which it lies."""
        index = attachment.index(self._position)
        self.add_record(attachment.record(source))
        self._summary.add_attachment(index)

    def add_record(self, parts: Iterable[bytes]) -> None:
        """Write a record of a kind of its own, given as it is to lie in the file."""
        for part in parts:
            self._write(part)

    def end_chunk(self) -> None:
        """Write the open chunk and its message indexes, if it holds anything."""
        if not self._open:
            return
        raw = bytes(self._open)
        times = [time for entries in self._places.values() for time, _ in entries]
        start, end = min(times), max(times)
        data = self._compressor.compress(raw)
        record = encoded(
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
            size = 16 * len(entries)
            indexes += INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
            indexes += struct.pack(f"<{2 * len(entries)}Q", *(n for pair in entries for n in pair))
        index = encoded(
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
        self._summary.add_chunk(chunk)
        self._open.clear()
        self._places.clear()

    def abandon(self) -> None:
        """Give up the open chunk and whatever a failed write has left in the file."""
        for channel, entries in self._places.items():
            self._counts[channel] -= len(entries)
        self._open.clear()
        self._places.clear()
        self._cut(self._position)

    def take_back(self, size: int) -> bool:
        """Give up the last chunks, ``size`` bytes or more; return False if there is none left."""
        gone = self._summary.take_back(size, self._position)
        if not gone:
            return False
        for chunk in gone:
            for channel, count in chunk.counts.items():
                self._counts[channel] -= count
        self._cut(gone[-1].offset)
        return True

    def finish(self) -> None:
        """Write the last chunk, the summary and the footer; the stream stays open."""
        self.end_chunk()
        # In one piece: a summary that does not fit is cut off again as a whole.
        self._write(self._summary.encoded(self._position, self._counts))

    def _write(self, data: bytes | bytearray) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._stream.write(rest) :]
        self._position += len(data)

    def _cut(self, position: int) -> None:
        self._stream.seek(position)
        self._stream.truncate()
        self._position = position
