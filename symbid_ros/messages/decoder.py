"""Messages of one topic into arrays: by layout, and one by one what leaves it."""

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zstandard
from rosbags.serde import SerdeError

from symbid_ros.arrays import BoolArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import (
    ENCAPSULATION,
    ByteArray,
    Layout,
    Records,
    gather_rows,
    typestore,
)
from symbid_ros.messages.limits import (
    MAX_CHUNK,
    MAX_MESSAGE,
    MAX_NAMES,
    ZSTD_FRAME,
    check_limit,
    decompress_message,
)
from symbid_ros.messages.topics import Topic

MAX_LAYOUTS = 32  # a log that changes shape with every message must not cost N² comparisons
MAX_TRAILING = 32  # Fast CDR pads behind the last field, and behind empty sequences more than once


@dataclass(frozen=True)
class DecodedBatch:
    """Messages of one layout.

    Attributes
    ----------
    layout : Layout
    index : (K,) int64
        Their places among the topic's messages.
    records : (K,) record array of ``layout.dtype``
    """

    layout: Layout
    index: IntArray
    records: Records


@dataclass
class TopicDecoder:
    """Collects the messages of one topic, block by block.

    Attributes
    ----------
    source : str
        Name of the bag, for messages to the user.
    topic : Topic
    pieces : list of DecodedBatch
        Everything decoded so far.
    count, decoded_singly : int
        Messages seen, and those that fitted no layout's bytes and were decoded by
        rosbags one at a time (big-endian ones, for instance).
    layouts : list of Layout
        Those met so far; decoders of one topic may share them.
    """

    source: str
    topic: Topic
    pieces: list[DecodedBatch] = field(default_factory=list)
    count: int = 0
    decoded_singly: int = 0
    layouts: list[Layout] = field(default_factory=list)

    def add(self, data: ByteArray, spans: IntArray) -> None:
        """Decode the payloads (N, 2: start, length) of one block of bytes."""
        if len(spans) and data[spans[0, 0] :][:4].tobytes() == ZSTD_FRAME:
            data, spans = self._unpacked(data, spans)
        pending = np.arange(len(spans))
        for layout in self.layouts:
            pending = self._take(layout, data, spans, pending)
        while len(pending):
            pending = self._learn(data, spans, pending)
        self.count += len(spans)

    def _unpacked(self, data: ByteArray, spans: IntArray) -> tuple[ByteArray, IntArray]:
        """Return payloads that were compressed one by one, one behind the other."""
        whole = bytearray()
        places = np.empty_like(spans)
        for message, (start, length) in enumerate(spans.tolist()):
            try:
                payload = decompress_message(data[start : start + length].tobytes(), MAX_MESSAGE)
                check_limit("a block of messages", len(whole) + len(payload), MAX_CHUNK)
            except (zstandard.ZstdError, ValueError) as error:
                raise self._refusal(message, error) from error
            places[message] = len(whole), len(payload)
            whole += payload
        return np.frombuffer(whole, dtype=np.uint8), places

    def _take(
        self, layout: Layout, data: ByteArray, spans: IntArray, pending: IntArray
    ) -> IntArray:
        """Decode what follows the layout and return what is left."""
        size = len(layout.template)
        extra = spans[pending, 1] - size
        fits = (extra >= 0) & (extra <= MAX_TRAILING)
        candidates = pending[fits]
        if len(candidates):
            rows = gather_rows(data, spans[candidates, 0], size)
            matched = layout.matches(rows)
            self._keep(layout, candidates[matched], rows if matched.all() else rows[matched])
            fits[fits] = matched
        left: IntArray = pending[~fits]
        return left

    def _learn(self, data: ByteArray, spans: IntArray, pending: IntArray) -> IntArray:
        """Decode messages singly until one brings a layout that others may share."""
        for place, message in enumerate(pending):
            start, length = spans[message]
            canonical, layout, is_new = self._decode(data[start : start + length], int(message))
            if is_new and len(self.layouts) < MAX_LAYOUTS:
                self.layouts.append(layout)
                if _follows(data[start : start + length], layout):
                    return self._take(layout, data, spans, pending[place:])
            self._keep(layout, np.array([message]), canonical[None, :])
            self.decoded_singly += 1
        return pending[:0]

    def _decode(self, payload: ByteArray, message: int) -> tuple[ByteArray, Layout, bool]:
        """Return the message little-endian and packed, its layout and whether that is new."""
        msgtype = self.topic.msgtype
        try:
            check_limit("a length", len(payload), MAX_MESSAGE)
            decoded = _deserialized(payload.tobytes(), msgtype)
            layout = Layout.of(decoded, msgtype)
            check_limit("a number of strings", sum(map(len, layout.text.values())), MAX_NAMES)
        except (SerdeError, struct.error, ValueError, IndexError, MemoryError) as error:
            raise self._refusal(message, error) from error
        canonical = np.frombuffer(layout.template, dtype=np.uint8)
        for known in self.layouts:
            if _follows(canonical, known):
                return canonical, known, False
        return canonical, layout, True

    def _refusal(self, message: int, error: Exception) -> DataError:
        return DataError(
            f"{self.source}: {self.topic.name}: message {self.count + message + 1} is not a "
            f"valid {self.topic.msgtype}: {error}; leave the topic out or take another copy of "
            "the bag"
        )

    def _keep(self, layout: Layout, messages: IntArray, rows: ByteArray) -> None:
        if len(messages):
            self.pieces.append(DecodedBatch(layout, self.count + messages, layout.view(rows)))


def _follows(payload: ByteArray, layout: Layout) -> bool:
    size = len(layout.template)
    if not 0 <= len(payload) - size <= MAX_TRAILING:
        return False
    verdict: BoolArray = layout.matches(payload[None, :size])
    return bool(verdict[0])


def _deserialized(payload: bytes, msgtype: str) -> Any:
    """Decode one message of either byte order.

    The type store's own ``deserialize_cdr`` refuses the trailing bytes that Fast
    CDR leaves behind messages with empty sequences.
    """
    store = typestore()
    if payload[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"its encapsulation 0x{payload[:2].hex()} is not plain CDR")
    definition = store.get_msgdef(msgtype)
    decode = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
    message, end = decode(payload[ENCAPSULATION:], 0, definition.cls, store)
    if len(payload) - ENCAPSULATION - end > MAX_TRAILING:
        raise ValueError("it is longer than its fields")
    return message
