"""Decode the messages of one topic into arrays, by layout where possible, else one by one."""

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zstandard
from rosbags.serde import SerdeError

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import (
    ENCAPSULATION,
    MAX_TRAILING,
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
    ZSTD_MAGIC,
    check_limit,
    decompress_message,
)
from symbid_ros.messages.topics import Topic

MAX_LAYOUTS = 32  # bounds the comparisons when each message has another shape


@dataclass(frozen=True)
class DecodedBatch:
    """Decoded messages of one layout.

    Attributes
    ----------
    layout : Layout
    index : (K,) int64
        Their positions among the topic's messages.
    records : (K,) record array of ``layout.dtype``
    """

    layout: Layout
    index: IntArray
    records: Records


@dataclass
class TopicDecoder:
    """Decodes the messages of one topic, block by block.

    Attributes
    ----------
    source : str
        Name of the bag, for error messages.
    topic : Topic
    batches : list of DecodedBatch
        All messages decoded so far.
    count, decoded_singly : int
        All messages, and those that matched no layout and were decoded one at a time by rosbags,
        such as big-endian ones.
    layouts : list of Layout
        Layouts found so far; decoders of one topic may share them.
    """

    source: str
    topic: Topic
    batches: list[DecodedBatch] = field(default_factory=list)
    count: int = 0
    decoded_singly: int = 0
    layouts: list[Layout] = field(default_factory=list)

    def add(self, data: ByteArray, spans: IntArray) -> None:
        """Decode the payloads (N, 2: start, length) of one block of bytes."""
        if len(spans) and data[spans[0, 0] :][:4].tobytes() == ZSTD_MAGIC:
            data, spans = self._decompress(data, spans)
        pending = np.arange(len(spans))
        for layout in self.layouts:
            pending = self._take(layout, data, spans, pending)
        while len(pending):
            pending = self._learn(data, spans, pending)
        self.count += len(spans)

    def _decompress(self, data: ByteArray, spans: IntArray) -> tuple[ByteArray, IntArray]:
        """Concatenate payloads that were compressed one by one."""
        joined = bytearray()
        places = np.empty_like(spans)
        for message, (start, length) in enumerate(spans.tolist()):
            try:
                payload = decompress_message(data[start : start + length].tobytes(), MAX_MESSAGE)
                check_limit("a block of messages", len(joined) + len(payload), MAX_CHUNK)
            except (zstandard.ZstdError, ValueError) as error:
                raise self._invalid_message(message, error) from error
            places[message] = len(joined), len(payload)
            joined += payload
        return np.frombuffer(joined, dtype=np.uint8), places

    def _take(
        self, layout: Layout, data: ByteArray, spans: IntArray, pending: IntArray
    ) -> IntArray:
        """Decode the messages of a layout and return the others."""
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
        """Decode messages one by one until one has a new layout that others may share."""
        for place, message in enumerate(pending):
            start, length = spans[message]
            canonical, layout, is_new = self._decode(data[start : start + length], int(message))
            if is_new and len(self.layouts) < MAX_LAYOUTS:
                self.layouts.append(layout)
                if layout.matches_payload(data[start : start + length]):
                    return self._take(layout, data, spans, pending[place:])
            self._keep(layout, np.array([message]), canonical[None, :])
            self.decoded_singly += 1
        return pending[:0]

    def _decode(self, payload: ByteArray, message: int) -> tuple[ByteArray, Layout, bool]:
        """Return the message in little-endian order, its layout, and whether that is new."""
        msgtype = self.topic.msgtype
        try:
            check_limit("its length", len(payload), MAX_MESSAGE)
            decoded = _deserialize(payload.tobytes(), msgtype)
            layout = Layout.of(decoded, msgtype)
            check_limit("its number of strings", sum(map(len, layout.text.values())), MAX_NAMES)
        except (SerdeError, struct.error, ValueError, IndexError, MemoryError) as error:
            raise self._invalid_message(message, error) from error
        canonical = np.frombuffer(layout.template, dtype=np.uint8)
        for known in self.layouts:
            if known.matches_payload(canonical):
                return canonical, known, False
        return canonical, layout, True

    def _invalid_message(self, message: int, error: Exception) -> DataError:
        return DataError(
            f"{self.source}: {self.topic.name}: message {self.count + message + 1} is not a "
            f"valid {self.topic.msgtype}: {error}; leave the topic out or use another copy of "
            "the bag",
            "E216",
        )

    def _keep(self, layout: Layout, messages: IntArray, rows: ByteArray) -> None:
        if len(messages):
            self.batches.append(DecodedBatch(layout, self.count + messages, layout.view(rows)))


def _deserialize(payload: bytes, msgtype: str) -> Any:
    """Decode one message of either byte order.

    The ``deserialize_cdr`` of rosbags rejects the trailing bytes that Fast CDR leaves after
    messages with empty sequences.
    """
    store = typestore()
    if payload[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"its encapsulation 0x{payload[:2].hex()} is not plain CDR")
    definition = store.get_msgdef(msgtype)
    decode = definition.deserialize_cdr_le if payload[1] else definition.deserialize_cdr_be
    message, end = decode(payload[ENCAPSULATION:], 0, definition.cls, store)
    if len(payload) - ENCAPSULATION - end > MAX_TRAILING:
        raise ValueError("there are bytes after its last field")
    return message
