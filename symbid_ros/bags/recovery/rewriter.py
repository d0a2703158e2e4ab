"""Write messages of other bags into a new one, with their original schemas and channels."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Self

from mcap.records import Channel, Metadata

from symbid_ros.bags.container.mcap_records import Attachment
from symbid_ros.bags.container.schema_registry import SchemaRegistry
from symbid_ros.bags.metadata import (
    FileMetadata,
    TopicMetadata,
    describe_bag,
    encode_metadata_record,
    write_metadata,
)
from symbid_ros.bags.writing.mcap_writer import McapWriter
from symbid_ros.messages.limits import MIB
from symbid_ros.messages.topics import OfferedQos

CHUNK_SIZE = MIB
ROSBAG2 = "rosbag2"  # name of the metadata record that rosbag2 keeps about a file


@dataclass(frozen=True)
class _Origin:
    """A channel of another file, without its number."""

    topic: str
    encoding: str
    schema: tuple[str, bytes, str] | None  # name, definition and its encoding
    metadata: tuple[tuple[str, str], ...]
    qos: tuple[OfferedQos, ...]

    def announce(self, writer: McapWriter) -> int:
        schema = 0 if self.schema is None else writer.add_schema(*self.schema)
        return writer.add_channel(self.topic, schema, dict(self.metadata), self.encoding)

    def topic_metadata(self) -> TopicMetadata:
        name = "" if self.schema is None else self.schema[0]
        type_hash = dict(self.metadata).get("topic_type_hash", "")
        return TopicMetadata(self.topic, name, self.qos, type_hash, self.encoding)


@dataclass
class BagRewriter:
    """Writes the files of a new bag; each topic has the same channel in all of them.

    Attributes
    ----------
    folder : Path
        Folder to create; files are named after it.
    compression_mode : str
        ``MESSAGE`` if each message is compressed by itself; the messages are copied as they are.
    """

    folder: Path
    compression_mode: str = ""
    _channels: dict[_Origin, int] = field(default_factory=dict)
    _files: list[FileMetadata] = field(default_factory=list)
    _stream: BinaryIO | None = None
    _writer: McapWriter | None = None

    def channel(self, registry: SchemaRegistry, channel: Channel) -> int:
        """Return the number in this bag of another file's channel."""
        schema = registry.schema(channel)
        try:
            qos = registry.offered_qos(channel)
        except ValueError:
            qos = ()
        origin = _Origin(
            channel.topic,
            channel.message_encoding,
            None if schema is None else (schema.name, schema.data, schema.encoding),
            tuple(channel.metadata.items()),
            qos,
        )
        if origin not in self._channels:
            self._channels[origin] = origin.announce(self._output())
        return self._channels[origin]

    def write(
        self, channel: int, log_time: int, publish_time: int, payload: bytes, sequence: int
    ) -> None:
        """Append a message to the current file; times in nanoseconds."""
        self._output().add_message(channel, log_time, publish_time, payload, sequence)

    def add_metadata(self, record: Metadata) -> None:
        """Write a metadata record."""
        self._output().add_metadata(record.name, record.metadata)

    def add_attachment(self, attachment: Attachment, source: BinaryIO) -> None:
        """Copy an attachment from the file that holds it."""
        self._output().add_attachment(attachment, source)

    def add_private(self, parts: Iterable[bytes]) -> None:
        """Write a private record unchanged."""
        self._output().add_record(parts)

    def end_file(self) -> None:
        """Finish the current file, if anything was written to it."""
        if self._writer is None or self._stream is None:
            return
        self._writer.end_chunk()
        name = Path(self._stream.name).name
        counts, summary = self._writer.counts, self._writer.summary
        self._files.append(FileMetadata(name, summary.start, summary.end, counts))
        self._writer.add_metadata(ROSBAG2, encode_metadata_record(self._information()))
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        self._writer = None

    def finish(self) -> None:
        """Write metadata.yaml; the bag is complete afterwards."""
        write_metadata(self.folder, self._information())

    def __enter__(self) -> Self:
        self.folder.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()

    def _output(self) -> McapWriter:
        """Return the writer of the current file, which is created when it is first needed."""
        if self._writer is None:
            self._stream = (self.folder / f"{self.folder.name}_{len(self._files)}.mcap").open("xb")
            self._writer = McapWriter(self._stream, CHUNK_SIZE)
            for origin in self._channels:
                origin.announce(self._writer)
        return self._writer

    def _information(self) -> dict[str, object]:
        topics = {number: origin.topic_metadata() for origin, number in self._channels.items()}
        return describe_bag(topics, self._files, self.compression_mode)
