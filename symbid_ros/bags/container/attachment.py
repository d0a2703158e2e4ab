"""Attachments of an MCAP file: files of any kind that were put beside the messages."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from mcap.records import AttachmentIndex

from symbid_ros.bags.container.framing import RECORD
from symbid_ros.messages.limits import MAX_RECORD, MIB, within

TIMES = struct.Struct("<QQ")
TEXT = struct.Struct("<I")
SIZE = struct.Struct("<Q")
CHECKSUM = struct.Struct("<I")


@dataclass(frozen=True)
class Attachment:
    """An attachment as it lies in a file; its content may be larger than memory.

    Attributes
    ----------
    offset, length : int
        Bytes of its record, head included.
    log_time, create_time : int
        Nanoseconds.
    name, media_type : str
    data_size : int
        Bytes of its content.
    """

    offset: int
    length: int
    log_time: int
    create_time: int
    name: str
    media_type: str
    data_size: int

    @classmethod
    def at(cls, stream: BinaryIO, offset: int, length: int) -> "Attachment":
        """Return the one whose record of ``length`` bytes begins at ``offset``, checked.

        Raises
        ------
        ValueError, struct.error
            When it is no attachment or does not match its checksum.
        """
        stream.seek(offset + RECORD.size)
        log_time, create_time = TIMES.unpack(stream.read(TIMES.size))
        name, media_type = _text(stream), _text(stream)
        (size,) = SIZE.unpack(stream.read(SIZE.size))
        start, stop = offset + RECORD.size, stream.tell() + size
        if stop + CHECKSUM.size > offset + length:
            raise ValueError("an attachment's size is not what its record says")
        crc = 0
        for part in record_parts(stream, start, stop - start):
            crc = zlib.crc32(part, crc)
        (told,) = CHECKSUM.unpack(stream.read(CHECKSUM.size))
        if told not in (0, crc):
            raise ValueError("an attachment does not match its checksum")
        return cls(offset, length, log_time, create_time, name, media_type, size)

    def record(self, stream: BinaryIO) -> Iterator[bytes]:
        """Yield the bytes of its record, some at a time."""
        return record_parts(stream, self.offset, self.length)

    def index(self, offset: int) -> AttachmentIndex:
        """Return the index record of a copy that begins at ``offset``."""
        return AttachmentIndex(
            offset=offset,
            length=self.length,
            log_time=self.log_time,
            create_time=self.create_time,
            data_size=self.data_size,
            name=self.name,
            media_type=self.media_type,
        )


def _text(stream: BinaryIO) -> str:
    (length,) = TEXT.unpack(stream.read(TEXT.size))
    return stream.read(within("a name", length, MAX_RECORD)).decode()


def record_parts(stream: BinaryIO, offset: int, length: int) -> Iterator[bytes]:
    """Yield bytes of a file that may be more than memory holds.

    Raises
    ------
    ValueError
        When the file ends before them.
    """
    stream.seek(offset)
    while length:
        part = stream.read(min(length, MIB))
        if not part:
            raise ValueError("it became shorter while it was read")
        length -= len(part)
        yield part
