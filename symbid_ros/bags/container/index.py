"""Where the messages of an MCAP file lie, so that they can be read in order of time.

An indexed file tells it in its summary. Any other is read once from beginning to end.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from symbid_ros.bags.container.catalogue import Catalogue
from symbid_ros.bags.container.compression import ChunkRecord, unpacked_message
from symbid_ros.bags.container.framing import MAGIC, MESSAGE, RECORD, Buffer, damage_named
from symbid_ros.bags.container.summary import Summary, read_summary
from symbid_ros.bags.limits import MAX_CHUNK, MAX_EXTENTS, within
from symbid_ros.bags.metadata import OfferedQos

EXTENT_SIZE = 1 << 20  # messages outside of chunks are read so many bytes at a time


@dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes
    ----------
    name, msgtype : str
        As recorded.
    encoding : str
        Of its messages; ROS 2 knows ``cdr`` alone.
    qos : tuple of OfferedQos
        What its publishers offered; empty where the bag does not tell.
    """

    name: str
    msgtype: str
    encoding: str
    qos: tuple[OfferedQos, ...]


class Extent(NamedTuple):
    """Successive records of a file, a chunk for instance, that hold messages.

    Attributes
    ----------
    start, end : int
        First and last log time, nanoseconds.
    offset, length : int
        Bytes of the file.
    """

    start: int
    end: int
    offset: int
    length: int


class StoredMessage(NamedTuple):
    """A message of a file: log time in nanoseconds, channel and serialised message."""

    log_time: int
    channel: int
    payload: bytes


@dataclass(frozen=True)
class FileIndex:
    """What an MCAP file holds and where.

    Attributes
    ----------
    file : Path
    topics : dict of int to RecordedTopic
        By channel.
    extents : tuple of Extent
        In no particular order; their times may overlap.
    """

    file: Path
    topics: dict[int, RecordedTopic]
    extents: tuple[Extent, ...]

    def messages(self, extent: Extent) -> list[StoredMessage]:
        """Return the messages of one extent as they lie there."""
        with damage_named(self.file):
            with self.file.open("rb") as stream:
                stream.seek(extent.offset)
                data = stream.read(within("a chunk", extent.length, MAX_CHUNK))
            messages = [
                _message(records, start, stop)
                for opcode, start, stop, records in _records(data)
                if opcode == Opcode.MESSAGE
            ]
            if not self.topics.keys() >= {message.channel for message in messages}:
                raise ValueError("a message's channel was never announced")
            if not all(extent.start <= message.log_time <= extent.end for message in messages):
                raise ValueError("a chunk's times are not what its index says")
        return messages


def read_index(file: Path) -> FileIndex:
    """Return the index of an MCAP file."""
    with damage_named(file):
        summary = read_summary(file, with_chunks=True)
        if not _is_complete(summary):
            return _Survey(file, summary.data_end).index()
        extents = tuple(
            Extent(
                chunk.message_start_time,
                chunk.message_end_time,
                chunk.chunk_start_offset,
                chunk.chunk_length,
            )
            for chunk in summary.chunks
            if chunk.message_index_offsets
        )
        if any(extent.offset + extent.length > summary.data_end for extent in extents):
            raise ValueError("its index points beyond its end")
        if len({extent.offset for extent in extents}) < len(extents):
            raise ValueError("its index names a chunk twice")
        return FileIndex(file, _topics(summary.catalogue), extents)


def _is_complete(summary: Summary) -> bool:
    """Tell whether a summary names all chunks and channels, and all messages lie in chunks."""
    told = summary.statistics
    return (
        told is not None
        and told.chunk_count == len(summary.chunks)
        and told.channel_count == len(summary.catalogue.channels)
        # Without its own index a chunk may or may not be empty.
        and (not told.message_count or any(c.message_index_offsets for c in summary.chunks))
    )


@dataclass
class _Survey:
    """A reading of a whole file that keeps no message."""

    file: Path
    end: int
    catalogue: Catalogue = field(default_factory=Catalogue)
    extents: list[Extent] = field(default_factory=list)

    def index(self) -> FileIndex:
        with self.file.open("rb") as stream:
            stream.seek(len(MAGIC))
            while (offset := stream.tell()) < self.end:
                head = stream.read(RECORD.size)
                opcode, length = RECORD.unpack(head)
                if offset + RECORD.size + length > self.end:
                    raise ValueError("a record is cut short")
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                    body = stream.read(within("a record", length, MAX_CHUNK))
                    self._add(offset, head + body)
                else:
                    stream.seek(length, 1)
        return FileIndex(self.file, _topics(self.catalogue), tuple(self.extents))

    def _add(self, offset: int, record: bytes) -> None:
        times = []
        for opcode, start, stop, data in _records(record):
            if opcode == Opcode.MESSAGE:
                times.append(_message(data, start, stop).log_time)
            else:
                self.catalogue.add(opcode, data[start:stop])
        if times:
            self._extend(Extent(min(times), max(times), offset, len(record)))

    def _extend(self, extent: Extent) -> None:
        """Keep an extent, joined to the one before if both are small and touch."""
        if self.extents:
            last = self.extents[-1]
            length = last.length + extent.length
            if last.offset + last.length == extent.offset and length <= EXTENT_SIZE:
                self.extents[-1] = Extent(
                    min(last.start, extent.start), max(last.end, extent.end), last.offset, length
                )
                return
        self.extents.append(extent)
        within("a number of chunks", len(self.extents), MAX_EXTENTS)


def _records(data: Buffer, *, inside: bool = False) -> Iterator[tuple[int, int, int, Buffer]]:
    """Yield opcode, beginning and end of each record's body and the bytes these lie in.

    Chunks are opened, what they hold is yielded instead; chunks hold none themselves.
    """
    position, end = 0, len(data)
    while position < end:
        opcode, length = RECORD.unpack_from(data, position)
        start = position + RECORD.size
        position = start + length
        if position > end:
            raise ValueError("a record reaches beyond its chunk")
        if opcode != Opcode.CHUNK:
            yield opcode, start, position, data
        elif inside:
            raise ValueError(f"a record of kind {opcode} is in a chunk")
        else:
            chunk = ChunkRecord.of(memoryview(data)[start:position])
            yield from _records(chunk.records(), inside=True)


def _message(data: Buffer, start: int, stop: int) -> StoredMessage:
    """Return the message whose record's body lies from ``start`` to ``stop``."""
    body = start + MESSAGE.size
    if body > stop:
        raise ValueError("a message record is too short")
    channel, _, log_time, _ = MESSAGE.unpack_from(data, start)
    return StoredMessage(log_time, channel, unpacked_message(bytes(data[body:stop]), MAX_CHUNK))


def _topics(catalogue: Catalogue) -> dict[int, RecordedTopic]:
    return {
        number: RecordedTopic(
            name=channel.topic,
            msgtype=schema.name if (schema := catalogue.schema(channel)) else "",
            encoding=channel.message_encoding,
            qos=catalogue.offers(channel),
        )
        for number, channel in catalogue.channels.items()
    }
