"""MCAP records: framing, chunks and attachments, parsed with checks of every stated size.

The mcap package parses the small records. It is not used for chunks and messages: it allocates
whatever size a chunk states, and makes a Python object of each message.
"""

import shlex
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex

from symbid_ros.errors import BagError
from symbid_ros.messages.limits import (
    ANY_RATIO_SIZE,
    MAX_CHUNK,
    MAX_EXPANSION,
    MAX_RECORD,
    MIB,
    ZSTD_MAGIC,
    OverLimitError,
    check_limit,
    decompress_zstd,
)

Buffer = bytes | memoryview
MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
PAYLOAD_OFFSET = RECORD.size + MESSAGE.size
INDEX_HEAD = struct.Struct("<HI")
INDEX_ENTRY_SIZE = 16
FOOTER_SIZE = RECORD.size + 20
LONGEST_MAGIC = 16
TO_ROS2 = "--src-typestore ros1_noetic --dst-typestore ros2_jazzy"  # ROS 2 headers lack a field
PRIVATE = 0x80  # first opcode of private records, which readers skip
UINT32 = struct.Struct("<I")
UINT64 = struct.Struct("<Q")
CHUNK_HEAD = struct.Struct("<QQQII")
TIMES = struct.Struct("<QQ")


class DamagedFileError(BagError):
    """A bag's file that `symbid bag recover` may repair.

    Parameters
    ----------
    file : Path
    fault : str
    advice : str
        What to do, with ``{recover}`` for the command.
    code : str
    """

    def __init__(self, file: Path, fault: str, advice: str, code: str) -> None:
        self.file, self.fault, self.advice = file, fault, advice
        super().__init__(f"{file}: {fault}; {self._advice_for(file)}", code)

    def with_bag(self, bag: Path) -> "DamagedFileError":
        """Return the error with the advice to recover the bag that the file is part of."""
        error = DamagedFileError(self.file, self.fault, self.advice, self.code)
        error.args = (f"{self.file}: {self.fault}; {self._advice_for(bag)}",)
        return error

    def _advice_for(self, bag: Path) -> str:
        return self.advice.format(recover=f"`symbid bag recover {quote_path(bag)}`")


@contextmanager
def advise_to_recover(bag: Path) -> Iterator[None]:
    """Let errors of damaged files advise to recover the bag, not one of its files."""
    try:
        yield
    except DamagedFileError as error:
        raise error.with_bag(bag) from error


@contextmanager
def report_damage(file: Path) -> Iterator[None]:
    """Turn errors of reading damaged records into a `BagError` that names the file."""
    try:
        yield
    except OverLimitError as error:
        raise DamagedFileError(
            file,
            f"{error}, as in a damaged or malicious file",
            "run {recover} or record in smaller chunks",
            "E207",
        ) from error
    except (
        struct.error,
        ValueError,
        McapError,
        zstandard.ZstdError,
        RuntimeError,  # of lz4, and recursion
        MemoryError,
    ) as error:
        raise damage_error(file, "MCAP", error) from error
    except OSError as error:
        raise unreadable_error(file, error) from error


def damage_error(file: Path, storage: str, error: Exception) -> DamagedFileError:
    """Return the error for a file whose content a parser rejected."""
    detail = " ".join(str(error).split())[:200]
    if isinstance(error, struct.error) or not detail:
        detail = "it ends early"
    return DamagedFileError(
        file, f"damaged {storage} file: {detail}", "use another copy or run {recover}", "E206"
    )


def unreadable_error(file: Path, error: OSError) -> BagError:
    """Return the error for a file that the operating system cannot read."""
    return BagError(
        f"{file}: cannot read: {error.strerror}; check its permissions and the disk", "E208"
    )


def quote_path(path: Path) -> str:
    """Return a path quoted for a shell."""
    return shlex.quote(str(path))


def identify_other_format(file: Path) -> str:
    """Return the format of a file that is not MCAP, from its first bytes, and how to convert it.

    The result is empty if the format is unknown.
    """
    with file.open("rb") as stream:
        head = stream.read(LONGEST_MAGIC)
    conversion = (
        f"rosbags-convert --src {quote_path(file)} --dst {quote_path(file.with_suffix(''))} "
        "--dst-storage mcap"
    )
    if head.startswith(b"#ROSBAG"):
        return f"a ROS 1 bag; convert it with `{conversion} {TO_ROS2}`"
    if head.startswith(SQLITE_MAGIC):
        return "an SQLite file; rename it to end in .db3"
    if head.startswith(ZSTD_MAGIC):
        return f"compressed as a whole; decompress it with `zstd -d {quote_path(file)}`"
    if head.startswith(b"\x04\x22\x4d\x18"):
        return f"compressed as a whole; decompress it with `lz4 -d {quote_path(file)}`"
    return "" if head else "empty; record it again, or give the other files of the bag"


def checked_size(file: Path) -> int:
    """Return the size of an MCAP file, which must have a header and a footer."""
    with file.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            known = identify_other_format(file)
            raise BagError(
                f"{file}: {known or 'not an MCAP file; give a bag or one of its files'}", "E204"
            )
        end = stream.seek(0, 2)
        stream.seek(max(0, end - FOOTER_SIZE - len(MAGIC)))
        ending = stream.read()
    if ending[-len(MAGIC) :] != MAGIC or ending[0] != Opcode.FOOTER:
        raise DamagedFileError(
            file, "the recording was interrupted, the file has no footer", "run {recover}", "E205"
        )
    return end


def find_messages(data: Buffer, announce: Callable[[int, Buffer], None]) -> "array[int]":
    """Return where message records begin among the records of a chunk.

    Parameters
    ----------
    data : bytes-like
        Complete records, one after the other.
    announce : callable
        Called with opcode and body of each schema and channel.
    """
    starts = array("q")
    position, end = 0, len(data)
    unpack = RECORD.unpack_from
    while position < end:
        opcode, length = unpack(data, position)
        following = position + RECORD.size + length
        if following > end:
            raise ValueError("a record extends beyond its chunk")
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE.size:
                raise ValueError("a message record is too short")
            starts.append(position)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            announce(opcode, data[position + RECORD.size : following])
        else:
            raise ValueError(f"a record of kind {opcode} is in a chunk")
        position = following
    return starts


class ChunkRecord(NamedTuple):
    """A chunk as stored in the file."""

    start: int  # first log time as stated, nanoseconds
    end: int  # last log time as stated, nanoseconds
    size: int  # stated bytes of the decompressed records
    crc: int  # CRC-32 of the decompressed records; 0 if the writer gave none
    compression: str  # zstd, lz4 or empty
    data: memoryview  # the compressed records

    @classmethod
    def parse(cls, body: Buffer) -> "ChunkRecord":
        """Parse the body of a chunk record without copying it."""
        view = memoryview(body)
        start, end, size, crc, length = CHUNK_HEAD.unpack_from(view)
        if length > 16:
            raise ValueError("a chunk does not name its compression")
        name = CHUNK_HEAD.size + length
        (packed,) = UINT64.unpack_from(view, name)
        data = view[name + UINT64.size :][:packed]
        if len(data) != packed:
            raise ValueError("a chunk's size is not what its record says")
        return cls(start, end, size, crc, str(view[CHUNK_HEAD.size : name], "utf-8"), data)

    def decompress(self) -> Buffer:
        """Decompress the records and check them against the stated size and checksum."""
        check_limit("a chunk", self.size, MAX_CHUNK)
        if self.size > ANY_RATIO_SIZE:
            check_limit("a compression ratio", self.size // max(len(self.data), 1), MAX_EXPANSION)
        data = self._decompress_data()
        if len(data) != self.size:
            raise ValueError("a chunk's size is not what its record says")
        if self.crc and zlib.crc32(data) != self.crc:
            raise ValueError("a chunk does not match its checksum")
        return data

    def _decompress_data(self) -> Buffer:
        """Decompress, and stop one byte after the stated size."""
        if self.compression == "":
            return self.data
        if not self.size:
            return b""
        if self.compression == "zstd":
            return decompress_zstd(self.data, self.size)
        if self.compression == "lz4":
            return _decompress_lz4(self.data, self.size)
        raise ValueError(f"unknown compression {self.compression!r}")


def _decompress_lz4(data: memoryview, size: int) -> bytes:
    # lz4.frame.decompress allocates whatever the frame states, and drops further frames.
    parts: list[bytes] = []
    left = size + 1
    rest: Buffer | None = data
    while rest and left:
        frame = lz4.frame.LZ4FrameDecompressor()
        part = frame.decompress(rest, max_length=left)
        parts.append(part)
        left -= len(part)
        if not frame.eof:
            break
        rest = frame.unused_data
    return parts[0] if len(parts) == 1 else b"".join(parts)


@dataclass(frozen=True)
class Attachment:
    """An attachment as stored in a file; its content may be larger than memory."""

    offset: int  # of its record
    length: int  # bytes of its record, header included
    log_time: int  # nanoseconds
    create_time: int  # nanoseconds
    name: str
    media_type: str
    data_size: int  # bytes of its content

    @classmethod
    def read(cls, stream: BinaryIO, offset: int, length: int) -> "Attachment":
        """Read and check the attachment whose record has ``length`` bytes from ``offset`` on.

        Raises
        ------
        ValueError, struct.error
            When it is not an attachment or does not match its checksum.
        """
        stream.seek(offset + RECORD.size)
        log_time, create_time = TIMES.unpack(stream.read(TIMES.size))
        name, media_type = _text(stream), _text(stream)
        (size,) = UINT64.unpack(stream.read(UINT64.size))
        start, stop = offset + RECORD.size, stream.tell() + size
        if stop + UINT32.size > offset + length:
            raise ValueError("an attachment's size is not what its record says")
        crc = 0
        for part in read_parts(stream, start, stop - start):
            crc = zlib.crc32(part, crc)
        (stated,) = UINT32.unpack(stream.read(UINT32.size))
        if stated not in (0, crc):
            raise ValueError("an attachment does not match its checksum")
        return cls(offset, length, log_time, create_time, name, media_type, size)

    def record(self, stream: BinaryIO) -> Iterator[bytes]:
        """Yield the bytes of its record in parts."""
        return read_parts(stream, self.offset, self.length)

    def index(self, offset: int) -> AttachmentIndex:
        """Return the index record of a copy at ``offset``."""
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
    (length,) = UINT32.unpack(stream.read(UINT32.size))
    return stream.read(check_limit("a name", length, MAX_RECORD)).decode()


def read_parts(stream: BinaryIO, offset: int, length: int) -> Iterator[bytes]:
    """Yield part of a file that may be larger than memory, some bytes at a time.

    Raises
    ------
    ValueError
        When the file ends early.
    """
    stream.seek(offset)
    while length:
        part = stream.read(min(length, MIB))
        if not part:
            raise ValueError("it became shorter while it was read")
        length -= len(part)
        yield part
