"""Searches in damaged files, on records whose places are known."""

import io
import re
import struct

import pytest
from mcap.opcode import Opcode

from symbid_ros.bags.recovery import damaged_mcap
from symbid_ros.bags.recovery.damaged_mcap import (
    LONGEST_PATTERN,
    MAX_CHUNK,
    MAX_EXTRA_FIELDS,
    MAX_RECORD,
    count_indexed_messages,
    find_announcements,
    find_index_end,
    find_pattern,
    is_message_chain,
    is_record,
)


def record(opcode, body=b""):
    return struct.pack("<BQ", opcode, len(body)) + body


def index(channel, entries, *, extra=b"", size=None):
    body = struct.pack("<HI", channel, 16 * entries if size is None else size)
    return record(Opcode.MESSAGE_INDEX, body + bytes(16 * entries) + extra)


def message(channel, payload=b"payload"):
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", channel, 0, 1, 1) + payload)


@pytest.mark.parametrize("window", [7, 50, 64, 1000])
@pytest.mark.parametrize(("start", "end"), [(0, 300), (1, 300), (20, 121), (20, 120), (299, 300)])
def test_patterns_are_found_once_wherever_a_window_ends(monkeypatch, window, start, end):
    monkeypatch.setattr(damaged_mcap, "WINDOW", window)
    places = [0, 1, 6, 7, 49, 50, 99, 100, 120, 255, 299]
    data = bytearray(400)
    for place in places:
        data[place] = 0x55
    pattern = re.compile(rb"\x55(?=.{44})", re.DOTALL)  # as long as the longest of the module
    assert LONGEST_PATTERN == 45
    found = list(find_pattern(io.BytesIO(bytes(data)), pattern, start, end))
    assert found == [place for place in places if start <= place < end]


@pytest.mark.parametrize(
    ("opcode", "length", "expected"),
    [
        (Opcode.HEADER, 10, True),
        (Opcode.DATA_END, 10, True),
        (Opcode.MESSAGE, 11, True),  # beyond the file, but shorter than a chunk may be
        (Opcode.MESSAGE, MAX_CHUNK, True),
        (Opcode.MESSAGE, MAX_CHUNK + 1, False),
        (Opcode.DATA_END + 1, 10, False),
        (0, 10, False),
        (0x7F, 10, False),
        (0x80, 10, True),
        (0xFF, 10, True),
    ],
)
def test_a_record_has_a_known_kind_and_a_possible_length(opcode, length, expected):
    data = b"before" + struct.pack("<BQ", opcode, length) + bytes(10)
    assert is_record(io.BytesIO(data), 6, len(data)) is expected


def test_the_end_of_a_file_may_follow_a_record():
    data = bytes(8)
    assert is_record(io.BytesIO(data), 0, 8)
    assert is_record(io.BytesIO(data), 8, 8)
    assert not is_record(io.BytesIO(data), 9, 8)
    long = struct.pack("<BQ", Opcode.MESSAGE, MAX_CHUNK + 1) + bytes(MAX_CHUNK + 1)
    assert is_record(io.BytesIO(long), 0, len(long))
    assert not is_record(io.BytesIO(long[:-1]), 0, len(long) - 1)


@pytest.mark.parametrize(
    ("last", "is_index"),
    [
        (index(3, 2), True),
        (index(3, 0), True),
        (index(3, 2, extra=bytes(MAX_EXTRA_FIELDS)), True),
        (index(3, 2, extra=bytes(MAX_EXTRA_FIELDS + 1)), False),
        (index(3, 2, size=33), False),
        (index(3, 2, size=48), False),
        (index(3, 2)[:-1], False),
        (index(3, 0)[:14], False),
        (message(3), False),
        (record(Opcode.MESSAGE_INDEX, b"short"), False),
        (b"", False),
    ],
)
def test_message_indexes_end_at_the_first_other_bytes(last, is_index):
    before = index(1, 1) + index(2, 3)
    data = b"xy" + before + last
    end = 2 + len(before) + (len(last) if is_index else 0)
    assert find_index_end(io.BytesIO(data), 2, len(data)) == end
    assert find_index_end(io.BytesIO(data), 1, len(data)) == 1


def test_indexed_messages_are_counted_by_channel():
    parts = [b"junk", index(1, 2), b"\x07junk", index(2, 0), index(1, 3), index(7, 1)]
    stream = io.BytesIO(b"".join(parts))
    size = len(b"".join(parts))
    assert count_indexed_messages(stream, 0, size) == {1: 5, 7: 1}
    last = size - len(parts[-1])
    assert count_indexed_messages(stream, 0, last) == {1: 5}
    assert count_indexed_messages(stream, last, size) == {7: 1}
    assert count_indexed_messages(stream, 5, size) == {1: 3, 7: 1}


def test_schemas_and_channels_are_found_where_they_fit():
    schema, channel = record(Opcode.SCHEMA, b"schema!!"), record(Opcode.CHANNEL, b"channel")
    data = b"junk" + schema + b"\0\0" + message(1) + channel
    stream = io.BytesIO(data)
    expected = [(Opcode.SCHEMA, b"schema!!"), (Opcode.CHANNEL, b"channel")]
    assert list(find_announcements(stream, 0, len(data))) == expected
    assert list(find_announcements(stream, 5, len(data))) == expected[1:]
    # The last one ends beyond the place to stop.
    assert list(find_announcements(stream, 0, len(data) - 1)) == expected[:1]
    for size, count in ((MAX_RECORD, 1), (MAX_RECORD + 1, 0)):
        large = record(Opcode.SCHEMA, bytes(size))
        assert len(list(find_announcements(io.BytesIO(large), 0, len(large)))) == count


KNOWN = {1, 2}


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        ([message(1), message(2), message(1), b"junk" * 9], True),  # three are enough
        ([message(1), message(2), message(3)], False),
        ([message(3)], False),
        ([message(1), message(2)], True),  # up to the end of the file
        ([message(1, b"")], True),
        ([message(1), record(Opcode.DATA_END, bytes(4))], True),
        ([message(1), b"\xff\0"], True),  # fewer bytes than a record's head
        ([message(1), bytes(40)], False),
        ([message(1), record(Opcode.MESSAGE, bytes(21)) + bytes(9)], False),
        ([message(1), message(2)[:-1]], False),
        ([message(1), message(2), message(1)[:-1]], False),
        ([message(1), message(2)[:30]], False),
    ],
)
def test_messages_of_known_channels_follow_one_another(records, expected):
    data = b"xyz" + b"".join(records)
    assert is_message_chain(io.BytesIO(data), 3, len(data), KNOWN) is expected
