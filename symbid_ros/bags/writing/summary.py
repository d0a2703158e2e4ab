"""The end of an MCAP file: a summary of the records before it, and the footer."""

import zlib
from typing import NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from symbid_ros.bags.container.framing import MAGIC

FRAME_SIZE = 512  # bytes, at most, of data end, statistics, summary offsets, footer and magic
STATISTICS_ENTRY = 16  # bytes, at most, that a channel adds to the statistics


class StoredChunk(NamedTuple):
    """A chunk that lies in the file, with what its index tells of it."""

    offset: int
    start: int
    end: int
    index_record: bytes
    counts: dict[int, int]


class Summary:
    """What lies in a file, told again at its end.

    Attributes
    ----------
    schemas, channels, chunks, metadata, attachments : list
        Records of the file, in its order.
    """

    def __init__(self) -> None:
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self.chunks: list[StoredChunk] = []
        self.metadata: list[MetadataIndex] = []
        self.attachments: list[AttachmentIndex] = []
        self._size = FRAME_SIZE

    @property
    def size(self) -> int:
        """Bytes, at most, of `encoded`."""
        return self._size

    @property
    def start(self) -> int:
        """Smallest log time in the file's chunks, nanoseconds; 0 without any."""
        return min((chunk.start for chunk in self.chunks), default=0)

    @property
    def end(self) -> int:
        """Largest log time in the file's chunks, nanoseconds; 0 without any."""
        return max((chunk.end for chunk in self.chunks), default=0)

    def add_schema(self, schema: Schema) -> None:
        """Note a type's definition."""
        self.schemas.append(schema)
        self._size += len(encoded(schema))

    def add_channel(self, channel: Channel) -> None:
        """Note a channel."""
        self.channels.append(channel)
        self._size += len(encoded(channel)) + STATISTICS_ENTRY

    def add_chunk(self, chunk: StoredChunk) -> None:
        """Note a chunk."""
        self.chunks.append(chunk)
        self._size += len(chunk.index_record)

    def add_metadata(self, place: MetadataIndex) -> None:
        """Note where a metadata record lies."""
        self.metadata.append(place)
        self._size += len(encoded(place))

    def add_attachment(self, place: AttachmentIndex) -> None:
        """Note where an attachment lies."""
        self.attachments.append(place)
        self._size += len(encoded(place))

    def take_back(self, size: int, end: int) -> list[StoredChunk]:
        """Forget the last chunks and what lies behind them; return them, last first.

        Parameters
        ----------
        size : int
            Bytes that they span, at least, if there are as many.
        end : int
            Where the file ends.
        """
        gone: list[StoredChunk] = []
        cut = end
        while self.chunks and end - cut < size:
            gone.append(self.chunks.pop())
            cut = gone[-1].offset
            self._size -= len(gone[-1].index_record)
        # A channel announced behind the cut has no message left; it is still named.
        self.metadata = [place for place in self.metadata if place.offset < cut]
        self.attachments = [place for place in self.attachments if place.offset < cut]
        return gone

    def encoded(self, position: int, counts: dict[int, int]) -> bytes:
        """Return the end of a file whose data end at ``position``.

        ``counts`` are the file's messages by channel.
        """
        data_end = encoded(DataEnd(data_section_crc=0))
        start = position + len(data_end)
        summary = bytearray()
        offsets = bytearray()
        groups = [
            (Opcode.SCHEMA, [encoded(schema) for schema in self.schemas]),
            (Opcode.CHANNEL, [encoded(channel) for channel in self.channels]),
            (Opcode.STATISTICS, [encoded(self._statistics(counts))]),
            (Opcode.CHUNK_INDEX, [chunk.index_record for chunk in self.chunks]),
            (Opcode.METADATA_INDEX, [encoded(place) for place in self.metadata]),
            (Opcode.ATTACHMENT_INDEX, [encoded(place) for place in self.attachments]),
        ]
        for opcode, records in groups:
            body = b"".join(records)
            if body:
                offsets += encoded(SummaryOffset(opcode, start + len(summary), len(body)))
                summary += body
        footer = Footer(start, start + len(summary), summary_crc=0)
        # The checksum covers the footer as well, up to itself.
        footer.summary_crc = zlib.crc32(summary + offsets + encoded(footer)[:-4])
        return data_end + summary + offsets + encoded(footer) + MAGIC

    def _statistics(self, counts: dict[int, int]) -> Statistics:
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=counts,
            chunk_count=len(self.chunks),
            message_count=sum(counts.values()),
            message_start_time=self.start,
            message_end_time=self.end,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


def encoded(record: McapRecord) -> bytes:
    """Return a record as it lies in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
