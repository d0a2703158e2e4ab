"""Blocks of messages: what an index says is compared with the bytes."""

import struct

import numpy as np
import pytest
from mcap.opcode import Opcode

from symbid_ros.bags.container.blocks import ChunkBatch, _is_complete, _message_heads
from symbid_ros.bags.container.mcap_records import PAYLOAD_OFFSET, ChunkRecord


def message(channel, payload):
    body = struct.pack("<HIQQ", channel, 0, 1, 1) + payload
    return struct.pack("<BQ", Opcode.MESSAGE, len(body)) + body


MESSAGES = [message(5, b"one"), message(258, b""), message(7, b"three")]
DATA = np.frombuffer(b"".join(MESSAGES), dtype=np.uint8)
STARTS = np.cumsum([0, *map(len, MESSAGES)])[:-1]


def test_heads_are_read_where_messages_begin():
    heads = _message_heads(DATA, STARTS)
    assert heads["opcode"].tolist() == [5, 5, 5]
    assert heads["channel"].tolist() == [5, 258, 7]
    assert heads["length"].tolist() == [len(each) - 9 for each in MESSAGES]
    assert _is_complete(heads, STARTS, len(DATA))
    assert len(_message_heads(DATA, STARTS[:0])) == 0
    assert _is_complete(_message_heads(DATA[:0], STARTS[:0]), STARTS[:0], 0)


@pytest.mark.parametrize(
    ("starts", "is_inside"),
    [
        ([-1], False),
        ([0], True),
        ([len(DATA) - PAYLOAD_OFFSET], True),
        ([len(DATA) - PAYLOAD_OFFSET + 1], False),
        ([0, len(DATA)], False),
        ([2**62], False),
    ],
)
def test_an_index_points_into_its_chunk(starts, is_inside):
    assert (_message_heads(DATA, np.array(starts)) is not None) is is_inside


@pytest.mark.parametrize(
    "starts", [STARTS[1:], STARTS[:-1], STARTS[[0, 2]], STARTS[[0, 1, 1, 2]], STARTS[:0]]
)
def test_an_index_that_leaves_messages_out_is_not_trusted(starts):
    assert not _is_complete(_message_heads(DATA, starts), starts, len(DATA))


@pytest.mark.parametrize(("place", "value"), [(0, Opcode.SCHEMA), (1, 21)])
def test_only_messages_are_trusted(place, value):
    data = bytearray(DATA)
    data[place] = value
    if place == 1:  # one byte shorter than a message can be, and the next one as much longer
        data = bytearray(struct.pack("<BQ", Opcode.MESSAGE, 21) + bytes(21))
    found = np.frombuffer(bytes(data), dtype=np.uint8)
    starts = STARTS if place == 0 else STARTS[:1]
    padded = np.append(found, np.zeros(9, dtype=np.uint8))
    heads = _message_heads(padded, starts)
    assert not _is_complete(heads, starts, len(found))


def chunk(records, *, crc=1):
    body = struct.pack("<QQQII", 1, 2, len(records), crc, 0) + struct.pack("<Q", len(records))
    return ChunkRecord.parse(body + records)


def index(*offsets, size=None):
    entries = b"".join(struct.pack("<QQ", 9, offset) for offset in offsets)
    return struct.pack("<HI", 1, len(entries) if size is None else size) + entries


def test_positions_in_several_chunks_are_those_in_the_whole_batch():
    batch = ChunkBatch()
    batch.add_chunk(chunk(MESSAGES[0] + MESSAGES[1]))
    batch.add_index(index(len(MESSAGES[0])))
    batch.add_index(index(0))
    batch.add_chunk(chunk(MESSAGES[2], crc=0))
    batch.add_index(index(0) + b"later fields")
    assert batch.starts().tolist() == STARTS.tolist()
    assert (batch.size, batch.chunks, batch.unchecked) == (len(DATA), 2, 1)
    batch.add_message(MESSAGES[0])
    assert (batch.size, batch.chunks) == (len(DATA) + len(MESSAGES[0]), 2)


def test_an_index_with_more_entries_than_messages_fit_in_is_ignored():
    batch = ChunkBatch()
    empty = message(1, b"")
    batch.add_chunk(chunk(empty * 3))
    batch.add_index(index(0, len(empty), 2 * len(empty)))
    assert len(batch.starts()) == 3
    batch.add_index(index(0))
    assert len(batch.starts()) == 0


@pytest.mark.parametrize("body", [index(0, size=32), index(0, size=15), index(0, 1, size=31)])
def test_a_truncated_index_is_rejected(body):
    batch = ChunkBatch()
    batch.add_chunk(chunk(MESSAGES[0]))
    with pytest.raises(ValueError, match="truncated"):
        batch.add_index(body)
