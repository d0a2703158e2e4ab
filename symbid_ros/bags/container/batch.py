"""Successive chunks of a file that are worked on together."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.bags.container.compression import ChunkRecord
from symbid_ros.bags.container.framing import INDEX_ENTRY, INDEX_HEAD, PAYLOAD, Buffer


@dataclass
class Batch:
    """Chunks as they lie in the file, and where their indexes say messages begin.

    Attributes
    ----------
    size : int
        Bytes of all records inside, as the chunks state them.
    chunks, unchecked : int
        Number of chunks, and of those without a checksum.
    """

    size: int = 0
    chunks: int = 0
    unchecked: int = 0
    _parts: list[ChunkRecord | bytes] = field(default_factory=list)
    _base: int = 0
    _entries: list[bytes] = field(default_factory=list)
    _places: list[tuple[int, int]] = field(default_factory=list)

    def add_message(self, record: bytes) -> None:
        """Take a message's record, which lies in no chunk."""
        self._add(record, len(record))

    def add_chunk(self, chunk: ChunkRecord) -> None:
        """Take a chunk; it is unpacked later."""
        self._add(chunk, chunk.size)
        self.chunks += 1
        self.unchecked += not chunk.crc

    def add_index(self, body: bytes) -> None:
        """Take the body of a message index of the last chunk: channel, size, entries."""
        _, size = INDEX_HEAD.unpack_from(body)
        entries = body[INDEX_HEAD.size : INDEX_HEAD.size + size]
        if len(entries) < size or size % INDEX_ENTRY:
            raise ValueError("a message index is cut short")
        self._entries.append(entries)
        self._places.append((self._base, size // INDEX_ENTRY))

    def unpacked(self) -> Buffer:
        """Return all records, checked chunk by chunk against size and checksum."""
        parts = [part if isinstance(part, bytes) else part.records() for part in self._parts]
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def starts(self) -> IntArray:
        """Return where messages begin according to the indexes, in increasing order (N,)."""
        count = sum(count for _, count in self._places)
        if count * PAYLOAD > self.size:  # more entries than there is room for messages
            return np.empty(0, dtype=np.int64)
        entries = np.frombuffer(b"".join(self._entries), dtype="<i8").reshape(-1, 2)
        bases, counts = np.array(self._places, dtype=np.int64).reshape(-1, 2).T
        return np.sort(entries[:, 1] + np.repeat(bases, counts))

    def _add(self, part: ChunkRecord | bytes, size: int) -> None:
        self._base = self.size
        self._parts.append(part)
        self.size += size
