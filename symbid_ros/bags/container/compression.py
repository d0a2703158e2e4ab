"""Chunks unpacked: no more memory than their stated size, and no byte unchecked."""

import struct
import zlib
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from symbid_ros.bags.container.framing import Buffer
from symbid_ros.messages.compression import unpacked_zstd
from symbid_ros.messages.limits import MAX_CHUNK, MAX_EXPANSION, UNSUSPICIOUS, within

HEAD = struct.Struct("<QQQII")
LENGTH = struct.Struct("<Q")


class ChunkRecord(NamedTuple):
    """A chunk as it lies in the file.

    Attributes
    ----------
    start, end : int
        First and last log time as stated, nanoseconds.
    size : int
        Stated bytes of the records inside.
    crc : int
        CRC-32 of the records inside; 0 where the writer gave none.
    compression : str
        ``zstd``, ``lz4`` or nothing.
    data : memoryview
        The packed records.
    """

    start: int
    end: int
    size: int
    crc: int
    compression: str
    data: memoryview

    @classmethod
    def of(cls, body: Buffer) -> "ChunkRecord":
        """Parse the body of a chunk record; nothing is copied."""
        view = memoryview(body)
        start, end, size, crc, length = HEAD.unpack_from(view)
        if length > 16:
            raise ValueError("a chunk names no compression")
        name = HEAD.size + length
        (packed,) = LENGTH.unpack_from(view, name)
        data = view[name + LENGTH.size :][:packed]
        if len(data) != packed:
            raise ValueError("a chunk's size is not what its record says")
        return cls(start, end, size, crc, str(view[HEAD.size : name], "utf-8"), data)

    def records(self) -> Buffer:
        """Return the records inside, checked against the stated size and checksum."""
        within("a chunk", self.size, MAX_CHUNK)
        if self.size > UNSUSPICIOUS:
            within("an expansion", self.size // max(len(self.data), 1), MAX_EXPANSION)
        data = self._unpacked()
        if len(data) != self.size:
            raise ValueError("a chunk's size is not what its record says")
        if self.crc and zlib.crc32(data) != self.crc:
            raise ValueError("a chunk does not match its checksum")
        return data

    def _unpacked(self) -> Buffer:
        """Return at most one byte more than the stated size."""
        if self.compression == "":
            return self.data
        if not self.size:
            return b""
        if self.compression == "zstd":
            return unpacked_zstd(self.data, self.size)
        if self.compression == "lz4":
            return _unpacked_lz4(self.data, self.size)
        raise ValueError(f"unknown compression {self.compression!r}")


def _unpacked_lz4(data: memoryview, size: int) -> bytes:
    # The one-call function would allocate whatever the frame states, and drops further frames.
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
