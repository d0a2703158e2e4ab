"""Records found again in bytes whose framing is lost."""

import re
from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from symbid_ros.bags.container.framing import INDEX_ENTRY, INDEX_HEAD, MESSAGE, PRIVATE, RECORD
from symbid_ros.messages.limits import MAX_CHUNK, MAX_RECORD, MIB

WINDOW = 4 * MIB
# A record's length is below 4 GiB: its upper bytes are zero, in compressed data a rare sight.
ANY = rb"(?=.{4}\0{4})"
COMPRESSION = rb"(?=.{36}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0))"
CHUNK = re.compile(rb"\x06" + ANY + COMPRESSION, re.DOTALL)
ANNOUNCEMENT = re.compile(rb"[\x03\x04]" + ANY, re.DOTALL)
INDEX = re.compile(rb"\x07" + ANY, re.DOTALL)
MESSAGES = re.compile(rb"\x05" + ANY, re.DOTALL)
MOST_FURTHER = 64  # bytes of fields that a later version of MCAP may append to an index
LONGEST = 45  # bytes that decide whether a pattern is there


def read_at(stream: BinaryIO, position: int, length: int) -> bytes:
    """Return bytes of a file; fewer where it ends."""
    stream.seek(position)
    return stream.read(length)


def candidates(
    stream: BinaryIO, pattern: re.Pattern[bytes], position: int, end: int
) -> Iterator[int]:
    """Yield where a pattern begins between ``position`` and ``end``."""
    while position < end:
        window = read_at(stream, position, WINDOW + LONGEST)
        for found in pattern.finditer(window):
            if found.start() < min(WINDOW, end - position):
                yield position + found.start()
        position += WINDOW


def is_record(stream: BinaryIO, position: int, size: int) -> bool:
    """Tell whether a record may begin here, or the file of ``size`` bytes ends or was cut here."""
    head = read_at(stream, position, RECORD.size)
    if len(head) < RECORD.size:
        return position <= size
    opcode, length = RECORD.unpack(head)
    if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE):
        return False
    return position + RECORD.size + length <= size or bool(length <= MAX_CHUNK)


def indexed_messages(stream: BinaryIO, position: int, end: int) -> dict[int, int]:
    """Return what message indexes between two places count, by channel."""
    counts: Counter[int] = Counter()
    for start in candidates(stream, INDEX, position, end):
        if index := _index(stream, start):
            counts[index.channel] += index.entries
    return {channel: count for channel, count in counts.items() if count}


def following_index(stream: BinaryIO, position: int, size: int) -> int:
    """Return where the message indexes that begin at ``position`` end."""
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
    """Return the message index at a place, if there is one."""
    head = read_at(stream, position, RECORD.size + INDEX_HEAD.size)
    if len(head) < RECORD.size + INDEX_HEAD.size or head[0] != Opcode.MESSAGE_INDEX:
        return None
    _, length = RECORD.unpack_from(head)
    channel, size = INDEX_HEAD.unpack_from(head, RECORD.size)
    further = length - INDEX_HEAD.size - size
    if not 0 <= further <= MOST_FURTHER or size % INDEX_ENTRY or length > MAX_CHUNK:
        return None
    return _Index(channel, size // INDEX_ENTRY, RECORD.size + length)


def announcements(stream: BinaryIO, position: int, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of what may be schemas and channels between two places."""
    for start in candidates(stream, ANNOUNCEMENT, position, end):
        opcode, length = RECORD.unpack(read_at(stream, start, RECORD.size))
        if length <= MAX_RECORD and start + RECORD.size + length <= end:
            yield opcode, read_at(stream, start + RECORD.size, length)


def message_chain(
    stream: BinaryIO, position: int, size: int, channels: set[int], times: int = 3
) -> bool:
    """Tell whether messages of known channels follow each other from here, or end the file."""
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
