"""MCAP's records: how they begin, and how a file begins and ends."""

import shlex
import struct
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from symbid_ros.errors import BagError
from symbid_ros.messages.limits import OverLimitError

Buffer = bytes | memoryview
MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
PAYLOAD = RECORD.size + MESSAGE.size
INDEX_HEAD = struct.Struct("<HI")
INDEX_ENTRY = 16
FOOTER_SIZE = RECORD.size + 20
LONGEST_MAGIC = 16
TO_ROS2 = "--src-typestore ros1_noetic --dst-typestore ros2_jazzy"  # headers lost a field
PRIVATE = 0x80  # opcodes from here on are applications' own; readers pass them over


@contextmanager
def damage_named(file: Path) -> Iterator[None]:
    """Turn what reading damaged records raises into one line that names the file."""
    try:
        yield
    except OverLimitError as error:
        raise BagError(
            f"{file}: {error}, as of a damaged or hostile file; "
            f"run `symbid bag recover {quoted(file)}` or record in smaller chunks"
        ) from error
    except (
        struct.error,
        ValueError,
        McapError,
        zstandard.ZstdError,
        RuntimeError,  # lz4's, and recursion
        MemoryError,
    ) as error:
        detail = " ".join(str(error).split())[:200]
        if isinstance(error, struct.error) or not detail:
            detail = "it ends early"
        raise BagError(
            f"{file}: damaged MCAP file: {detail}; take another copy or run "
            f"`symbid bag recover {quoted(file)}`"
        ) from error
    except OSError as error:
        raise BagError(f"{file}: cannot read: {error.strerror}") from error


def quoted(path: Path) -> str:
    """Return a path as a shell takes it."""
    return shlex.quote(str(path))


def other_kind(file: Path) -> str:
    """Return what a file is by its first bytes, if no MCAP file, and what to do with it."""
    with file.open("rb") as stream:
        head = stream.read(LONGEST_MAGIC)
    conversion = (
        f"rosbags-convert --src {quoted(file)} --dst {quoted(file.with_suffix(''))} "
        "--dst-storage mcap"
    )
    if head.startswith(b"#ROSBAG"):
        return f"a bag of ROS 1; convert it with `{conversion} {TO_ROS2}`"
    if head.startswith(b"SQLite format 3\0"):
        return "an SQLite file; give it the ending .db3"
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        return f"compressed as a whole; unpack it with `zstd -d {quoted(file)}`"
    if head.startswith(b"\x04\x22\x4d\x18"):
        return f"compressed as a whole; unpack it with `lz4 -d {quoted(file)}`"
    return "" if head else "empty; record it again, or give the bag's other files alone"


def checked_size(file: Path) -> int:
    """Return the size of an MCAP file that has its beginning and its end."""
    with file.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            known = other_kind(file)
            raise BagError(f"{file}: {known or 'not an MCAP file; give a bag or one of its files'}")
        end = stream.seek(0, 2)
        stream.seek(max(0, end - FOOTER_SIZE - len(MAGIC)))
        ending = stream.read()
    if ending[-len(MAGIC) :] != MAGIC or ending[0] != Opcode.FOOTER:
        raise BagError(
            f"{file}: the recording was interrupted, the file has no footer; "
            f"run `symbid bag recover {quoted(file)}`"
        )
    return end


def message_starts(data: Buffer, announce: Callable[[int, Buffer], None]) -> "array[int]":
    """Return where message records begin in the records of a chunk.

    Parameters
    ----------
    data : bytes-like
        Whole records, one after the other.
    announce : callable
        Takes opcode and body of the schemas and channels among them.
    """
    starts = array("q")
    position, end = 0, len(data)
    unpack = RECORD.unpack_from
    while position < end:
        opcode, length = unpack(data, position)
        following = position + RECORD.size + length
        if following > end:
            raise ValueError("a record reaches beyond its chunk")
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
