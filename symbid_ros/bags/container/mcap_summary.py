"""Read the summary at the end of an MCAP file and check it.

mcap's ``get_summary`` checks neither sizes nor the checksum, and keeps all chunk indexes.
"""

import logging
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, Footer, Statistics

from symbid_ros.bags.container.mcap_records import (
    FOOTER_SIZE,
    MAGIC,
    RECORD,
    checked_size,
    quote_path,
)
from symbid_ros.bags.container.schema_registry import (
    SchemaRegistry,
    UnknownSchemaError,
    parse_record,
)
from symbid_ros.messages.limits import MAX_EXTENTS, MAX_RECORD, MAX_REGISTRY, check_limit

DATA_END_SIZE = RECORD.size + 4
CHUNK_INDEX = int(Opcode.CHUNK_INDEX)  # names of enumerations are looked up slowly

logger = logging.getLogger("symbid_ros.bags")


@dataclass(frozen=True)
class McapSummary:
    """The summary of a finished file."""

    registry: SchemaRegistry  # schemas, and the channels whose schema is in the summary
    statistics: Statistics | None
    chunks: tuple[ChunkIndex, ...]  # empty unless requested
    data_end: int  # position after the data end record
    data_crc: int  # CRC-32 of the file up to its data end record; 0 if the writer gave none

    @property
    def has_topic_counts(self) -> bool:
        """Whether it lists all topics and the number of messages of each."""
        stated = self.statistics
        return (
            stated is not None
            and stated.channel_count == len(self.registry.channels)
            and stated.message_count == sum(stated.channel_message_counts.values())
        )


def read_summary(file: Path, *, with_chunks: bool = False) -> McapSummary:
    """Return the summary of a finished file, compared with its checksum.

    The summary of a long recording consists mostly of chunk indexes, which reading the file from
    beginning to end does not need.
    """
    end = checked_size(file) - FOOTER_SIZE - len(MAGIC)
    announced: list[tuple[int, bytes]] = []
    size = 0
    statistics = None
    chunks: list[ChunkIndex] = []
    with file.open("rb") as stream:
        stream.seek(end)
        tail = stream.read(FOOTER_SIZE)
        if RECORD.unpack_from(tail) != (Opcode.FOOTER, FOOTER_SIZE - RECORD.size):
            raise ValueError("its footer is invalid")
        footer = parse_record(Footer.read, tail[RECORD.size :])
        start = footer.summary_start or end
        if not len(MAGIC) <= start <= end:
            raise ValueError("its footer points beyond the file's end")
        data_crc = _data_crc(stream, start)
        stream.seek(start)
        position, crc = start, 0
        while position < end:
            head = stream.read(RECORD.size)
            opcode, length = RECORD.unpack(head)
            check_limit("a record", length, MAX_RECORD)
            position += RECORD.size + length
            if position > end:
                raise ValueError("a record of its summary is truncated")
            body = stream.read(length)
            crc = zlib.crc32(body, zlib.crc32(head, crc))
            if opcode == CHUNK_INDEX:  # most records
                if with_chunks:
                    chunks.append(parse_record(ChunkIndex.read, body))
                    check_limit("a number of chunks", len(chunks), MAX_EXTENTS)
            elif opcode == Opcode.STATISTICS:
                statistics = parse_record(Statistics.read, body)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                size = check_limit(
                    "the total size of schemas and channels", size + length, MAX_REGISTRY
                )
                announced.append((opcode, body))
    crc = zlib.crc32(tail[:-4], crc)  # up to the checksum itself
    if footer.summary_start and footer.summary_crc not in (0, crc):
        raise ValueError("its summary does not match its checksum")
    return McapSummary(_registry(announced), statistics, tuple(chunks), start, data_crc)


def warn_of_count_mismatch(file: Path, stated: Statistics | None, found: Mapping[int, int]) -> None:
    """Warn if the statistics of a file disagree with the messages found in it, by channel."""
    if stated is None:
        return
    by_channel = {
        channel: count for channel, count in stated.channel_message_counts.items() if count
    }
    total = sum(found.values())
    if total != stated.message_count:
        held = f"but it holds {total}"
    elif by_channel not in ({}, dict(found)):  # writers may omit the counts by channel
        held = "and it holds as many, but on other topics"
    else:
        return
    logger.warning(
        "%s: damaged: its summary counts %d messages, %s; `symbid bag recover %s` reports "
        "what is lost",
        file,
        stated.message_count,
        held,
        quote_path(file),
    )


def _registry(announced: Iterable[tuple[int, bytes]]) -> SchemaRegistry:
    """Return schemas and channels, which may be in any order.

    A channel is omitted if its schema is only in the data section.
    """
    registry = SchemaRegistry()
    for opcode, body in sorted(announced, key=itemgetter(0)):
        with suppress(UnknownSchemaError):
            registry.add(opcode, body)
    return registry


def _data_crc(stream: BinaryIO, end: int) -> int:
    """Return the checksum in the data end record, the last record before ``end``."""
    stream.seek(max(0, end - DATA_END_SIZE))
    record = stream.read(DATA_END_SIZE)
    if RECORD.unpack_from(record) != (Opcode.DATA_END, DATA_END_SIZE - RECORD.size):
        return 0  # missing, or with fields of a later version, which reading the data will detect
    crc: int = parse_record(DataEnd.read, record[RECORD.size :]).data_section_crc
    return crc
