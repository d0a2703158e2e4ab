"""Read the intact parts of a damaged MCAP file, and report the damaged ones.

A chunk is intact if it decompresses to its stated size, matches its checksum and consists of
complete records. After a fault, the reader searches for the next intact chunk.
"""

import re
import struct
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Metadata

from symbid_ros.bags.container.mcap_records import (
    FOOTER_SIZE,
    INDEX_ENTRY_SIZE,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    PRIVATE,
    RECORD,
    Attachment,
    Buffer,
    ChunkRecord,
    find_messages,
    report_damage,
)
from symbid_ros.bags.container.schema_registry import SchemaRegistry, parse_record
from symbid_ros.messages.limits import MAX_CHUNK, MAX_RECORD, MIB, check_limit

WINDOW = 4 * MIB
# A record's length is below 4 GiB: its upper bytes are zero, which is rare in compressed data.
ANY = rb"(?=.{4}\0{4})"
COMPRESSION = rb"(?=.{36}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0))"
CHUNK = re.compile(rb"\x06" + ANY + COMPRESSION, re.DOTALL)
ANNOUNCEMENT = re.compile(rb"[\x03\x04]" + ANY, re.DOTALL)
INDEX = re.compile(rb"\x07" + ANY, re.DOTALL)
MESSAGES = re.compile(rb"\x05" + ANY, re.DOTALL)
MAX_EXTRA_FIELDS = 64  # bytes that a later version of MCAP may append to an index
LONGEST_PATTERN = 45  # bytes


def read_at(stream: BinaryIO, position: int, length: int) -> bytes:
    """Return bytes of a file; fewer where it ends."""
    stream.seek(position)
    return stream.read(length)


def find_pattern(
    stream: BinaryIO, pattern: re.Pattern[bytes], position: int, end: int
) -> Iterator[int]:
    """Yield where a pattern begins between ``position`` and ``end``."""
    while position < end:
        window = read_at(stream, position, WINDOW + LONGEST_PATTERN)
        for found in pattern.finditer(window):
            if found.start() < min(WINDOW, end - position):
                yield position + found.start()
        position += WINDOW


def is_record(stream: BinaryIO, position: int, size: int) -> bool:
    """Return whether a record may begin here, or the file of ``size`` bytes ends here."""
    head = read_at(stream, position, RECORD.size)
    if len(head) < RECORD.size:
        return position <= size
    opcode, length = RECORD.unpack(head)
    if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE):
        return False
    return position + RECORD.size + length <= size or bool(length <= MAX_CHUNK)


def count_indexed_messages(stream: BinaryIO, position: int, end: int) -> dict[int, int]:
    """Return the counts of message indexes between two positions, by channel."""
    counts: Counter[int] = Counter()
    for start in find_pattern(stream, INDEX, position, end):
        if index := _index(stream, start):
            counts[index.channel] += index.entries
    return {channel: count for channel, count in counts.items() if count}


def find_index_end(stream: BinaryIO, position: int, size: int) -> int:
    """Return the end of the message indexes that begin at ``position``."""
    while index := _index(stream, position):
        if position + index.length > size:
            break
        position += index.length
    return position


class _Index(NamedTuple):
    """A message index: its channel, number of entries, and bytes of the record."""

    channel: int
    entries: int
    length: int


def _index(stream: BinaryIO, position: int) -> _Index | None:
    """Return the message index at a position, if there is one."""
    head = read_at(stream, position, RECORD.size + INDEX_HEAD.size)
    if len(head) < RECORD.size + INDEX_HEAD.size or head[0] != Opcode.MESSAGE_INDEX:
        return None
    _, length = RECORD.unpack_from(head)
    channel, size = INDEX_HEAD.unpack_from(head, RECORD.size)
    extra = length - INDEX_HEAD.size - size
    if not 0 <= extra <= MAX_EXTRA_FIELDS or size % INDEX_ENTRY_SIZE or length > MAX_CHUNK:
        return None
    return _Index(channel, size // INDEX_ENTRY_SIZE, RECORD.size + length)


def find_announcements(stream: BinaryIO, position: int, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of possible schemas and channels between two positions."""
    for start in find_pattern(stream, ANNOUNCEMENT, position, end):
        opcode, length = RECORD.unpack(read_at(stream, start, RECORD.size))
        if length <= MAX_RECORD and start + RECORD.size + length <= end:
            yield opcode, read_at(stream, start + RECORD.size, length)


def is_message_chain(
    stream: BinaryIO, position: int, size: int, channels: set[int], times: int = 3
) -> bool:
    """Return whether messages of known channels follow from here, up to the end of the file."""
    for _ in range(times):
        head = read_at(stream, position, RECORD.size + MESSAGE.size)
        if len(head) < RECORD.size or head[0] != Opcode.MESSAGE:
            return is_record(stream, position, size)
        _, length = RECORD.unpack_from(head)
        if len(head) < RECORD.size + MESSAGE.size or length < MESSAGE.size:
            return False
        channel, *_ = MESSAGE.unpack_from(head, RECORD.size)
        position += RECORD.size + length
        if channel not in channels or position > size:
            return False
    return True


FAULTS = (struct.error, ValueError, McapError, zstandard.ZstdError, RuntimeError)
# Bytes tried as chunks for each byte of the file: a malicious file could otherwise take for ever.
MAX_TRIED = 4
CUT_OFF = "cut off"


class MessageRun(NamedTuple):
    """Intact messages: bytes, and where message records begin in them."""

    data: Buffer
    starts: "array[int]"


class DamagedRange(NamedTuple):
    """Damaged bytes of a file."""

    offset: int
    length: int
    fault: str  # what is wrong
    messages: dict[int, int]  # lower bounds of the lost messages by channel
    is_counted: bool  # whether these are their exact numbers


class PrivateRecord(NamedTuple):
    """Position and size of a private record."""

    offset: int
    length: int


McapPart = MessageRun | DamagedRange | Metadata | Attachment | PrivateRecord


@dataclass
class DamagedMcapReader:
    """Reads one file from beginning to end, past all faults.

    Attributes
    ----------
    file : Path
    registry : SchemaRegistry
        Schemas and channels of an intact summary, extended by those found in the data.
    repeated : int
        Repeated chunks, which are skipped.
    damaged : Counter of int
        Records by opcode at which damaged bytes begin.
    """

    file: Path
    registry: SchemaRegistry
    repeated: int = 0
    damaged: Counter[int] = field(default_factory=Counter)
    _size: int = field(init=False)
    _allowance: int = field(init=False)
    _has_chunks: bool = False
    _seen: set[tuple[int, int, int, int]] = field(default_factory=set)

    def parts(self) -> Iterator[McapPart]:
        """Yield all parts in the order of the file."""
        with report_damage(self.file), self.file.open("rb") as stream:
            self._size = stream.seek(0, 2)
            self._allowance = MAX_TRIED * self._size + MIB
            position = len(MAGIC) if read_at(stream, 0, len(MAGIC)) == MAGIC else 0
            while position < self._size:
                tail = read_at(stream, position, FOOTER_SIZE + len(MAGIC))
                if tail[:1] == bytes([Opcode.FOOTER]) and tail[FOOTER_SIZE:] == MAGIC:
                    end = position + len(tail)
                    if end < self._size:
                        yield DamagedRange(
                            end, self._size - end, "other bytes after its end", {}, True
                        )
                    return
                part, position = self._part(stream, position)
                if part is not None:
                    yield part

    def _part(self, stream: BinaryIO, position: int) -> tuple[McapPart | None, int]:
        """Return the part at ``position``, if it matters, and where to continue."""
        head = read_at(stream, position, RECORD.size)
        if len(head) < RECORD.size:
            return DamagedRange(position, len(head), CUT_OFF, {}, True), self._size
        opcode, length = RECORD.unpack(head)
        end = position + RECORD.size + length
        is_inside = end <= self._size
        is_followed = is_inside and (
            is_record(stream, end, self._size)
            # An index states its length twice; if both agree, the index is intact.
            or find_index_end(stream, position, self._size) >= end
        )
        fault = "overwritten" if is_inside else CUT_OFF
        if is_followed or (is_inside and opcode == Opcode.CHUNK):
            try:
                return self._record(stream, position, opcode, length), end
            except FAULTS as error:
                fault = str(error) or "it ends early"
        self.damaged[opcode] += 1
        if not is_followed:
            return self._search(stream, position, fault)
        messages = count_indexed_messages(stream, end, find_index_end(stream, end, self._size))
        is_counted = bool(messages) or opcode not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX)
        return DamagedRange(position, end - position, fault, messages, is_counted), end

    def _record(
        self, stream: BinaryIO, position: int, opcode: int, length: int
    ) -> MessageRun | Metadata | Attachment | PrivateRecord | None:
        """Return the content of a complete record; None for schemas, channels and indexes."""
        start = position + RECORD.size
        if opcode == Opcode.CHUNK:
            return self._chunk(read_at(stream, start, check_limit("a chunk", length, MAX_CHUNK)))
        if opcode == Opcode.MESSAGE_INDEX:
            if find_index_end(stream, position, self._size) == position:
                raise ValueError("a message index is invalid")
        elif read_at(stream, start + length, 1) == bytes([Opcode.MESSAGE_INDEX]):
            raise ValueError("a message index does not follow a chunk")
        if opcode == Opcode.MESSAGE:
            check_limit("a message", length, MAX_CHUNK)
            record = read_at(stream, position, RECORD.size + length)
            return MessageRun(record, find_messages(record, self.registry.add))
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.registry.add(opcode, read_at(stream, start, length))
        elif opcode == Opcode.METADATA:
            metadata: Metadata = parse_record(Metadata.read, read_at(stream, start, length))
            return metadata
        elif opcode == Opcode.ATTACHMENT:
            return Attachment.read(stream, position, RECORD.size + length)
        elif opcode >= PRIVATE:
            return PrivateRecord(position, RECORD.size + length)
        return None

    def _chunk(self, body: bytes) -> MessageRun | None:
        self._allowance -= len(body)
        chunk = ChunkRecord.parse(body)
        data = chunk.decompress()
        starts = find_messages(data, self.registry.add)
        self._has_chunks = True
        key = chunk.start, chunk.end, chunk.size, chunk.crc
        if chunk.crc and key in self._seen:
            self.repeated += 1
            return None
        self._seen.add(key)
        return MessageRun(data, starts)

    def _search(self, stream: BinaryIO, position: int, fault: str) -> tuple[DamagedRange, int]:
        """Return the damaged bytes up to the next intact record, and where that begins."""
        following = self._next_chunk(stream, position + 1)
        messages = count_indexed_messages(stream, position, following)
        if following == self._size and not messages and not self._has_chunks:
            following = self._next_message(stream, position)
        for opcode, body in find_announcements(stream, position, following):
            self._announce(opcode, body)
        # Indexes count the messages of some chunks; the number of all chunks is unknown.
        return DamagedRange(
            position, following - position, fault, messages, is_counted=False
        ), following

    def _next_chunk(self, stream: BinaryIO, position: int) -> int:
        for start in find_pattern(stream, CHUNK, position, self._size):
            _, length = RECORD.unpack(read_at(stream, start, RECORD.size))
            if length > MAX_CHUNK or start + RECORD.size + length > self._size:
                continue
            if self._allowance < 0:
                break
            self._allowance -= length
            try:
                chunk = ChunkRecord.parse(read_at(stream, start + RECORD.size, length))
                # Its schemas and channels are added once it is read.
                find_messages(chunk.decompress(), lambda *_: None)
            except FAULTS:
                continue
            return start
        return self._size

    def _next_message(self, stream: BinaryIO, position: int) -> int:
        """Return where messages outside of chunks continue."""
        if read_at(stream, position, 1) == bytes([Opcode.CHUNK]):
            return self._size  # messages in a damaged chunk cannot be trusted
        channels = set(self.registry.channels)
        for start in find_pattern(stream, MESSAGES, position + 1, self._size):
            if is_message_chain(stream, start, self._size, channels):
                return start
        return self._size

    def _announce(self, opcode: int, body: bytes) -> None:
        """Add a possible schema or channel, unless it contradicts known ones."""
        try:
            self.registry.add(opcode, body)
        except FAULTS:
            return
