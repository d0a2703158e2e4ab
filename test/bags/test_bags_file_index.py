"""Indexes of files: when a summary is trusted, and how a scan joins records."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.records import ChunkIndex, Statistics

from symbid_ros.bags.container import file_index
from symbid_ros.bags.container.file_index import Extent, _FileScan, _indexed, _is_complete
from symbid_ros.messages.limits import OverLimitError


def chunk(start, end, messages, channels=2, extra=0):
    """Return the index of a chunk: per channel 15 bytes, and 16 per message."""
    return ChunkIndex(
        chunk_length=0,
        chunk_start_offset=0,
        compression="",
        compressed_size=0,
        message_end_time=end,
        message_index_length=15 * channels + 16 * messages + extra,
        message_index_offsets=dict.fromkeys(range(channels), 0),
        message_start_time=start,
        uncompressed_size=0,
    )


def summary(*chunks, statistics=True, **changes):
    stated = {
        "attachment_count": 0,
        "channel_count": 2,
        "channel_message_counts": {},
        "chunk_count": len(chunks),
        "message_count": round(sum(map(_indexed, chunks))),
        "message_end_time": 9,
        "message_start_time": 1,
        "metadata_count": 0,
        "schema_count": 1,
    }
    registry = SimpleNamespace(channels={1: None, 2: None})
    found = Statistics(**(stated | changes)) if statistics else None
    return SimpleNamespace(statistics=found, chunks=chunks, registry=registry)


FIRST, SECOND, EMPTY = chunk(1, 5, 3), chunk(4, 9, 2, channels=1), chunk(0, 0, 0, channels=0)


@pytest.mark.parametrize("messages", [0, 1, 7])
@pytest.mark.parametrize("channels", [0, 1, 3])
def test_indexed_messages_are_counted_by_the_length_of_the_indexes(messages, channels):
    assert _indexed(chunk(0, 1, messages, channels)) == messages
    assert _indexed(chunk(0, 1, messages, channels, extra=4)) == messages + 0.25


@pytest.mark.parametrize(
    ("found", "is_complete"),
    [
        (summary(FIRST, SECOND), True),
        (summary(SECOND, EMPTY, FIRST), True),
        (summary(message_start_time=0, message_end_time=0), True),
        (summary(EMPTY, message_start_time=0, message_end_time=0), True),
        (summary(FIRST, SECOND, statistics=False), False),
        (summary(FIRST, SECOND, channel_count=3), False),
        (summary(FIRST, SECOND, channel_count=1), False),
        (summary(FIRST, SECOND, chunk_count=3), False),
        (summary(FIRST, SECOND, chunk_count=1), False),
        (summary(FIRST, SECOND, message_count=6), False),
        (summary(FIRST, SECOND, message_count=4), False),
        (summary(chunk(1, 5, 3, extra=4), SECOND), False),
        (summary(FIRST, SECOND, message_start_time=0), False),
        (summary(FIRST, SECOND, message_end_time=8), False),
        (summary(chunk(1, 9, 3), chunk(5, 4, 2)), False),
        (summary(chunk(1, 9, 3), chunk(4, 4, 2)), True),
    ],
)
def test_a_summary_is_trusted_if_it_accounts_for_all_messages(found, is_complete):
    assert _is_complete(found) is is_complete


def joined(monkeypatch, *extents, size=100):
    monkeypatch.setattr(file_index, "EXTENT_SIZE", size)
    scan = _FileScan(Path("log.mcap"), None)
    for extent in extents:
        scan._extend(Extent(*extent))
    return [tuple(extent) for extent in scan.extents]


def test_small_neighbouring_records_are_read_together(monkeypatch):
    assert joined(monkeypatch, (5, 8, 10, 40), (2, 3, 50, 60)) == [(2, 8, 10, 100)]
    assert joined(monkeypatch, (5, 8, 10, 40), (9, 9, 50, 20), (1, 6, 70, 10)) == [(1, 9, 10, 70)]
    # Too long together, or with other records between them.
    apart = [(5, 8, 10, 40), (2, 3, 50, 61)]
    assert joined(monkeypatch, *apart) == apart
    apart = [(5, 8, 10, 40), (2, 3, 51, 10)]
    assert joined(monkeypatch, *apart) == apart
    apart = [(1, 1, 0, 90), (2, 2, 90, 20), (3, 3, 110, 10)]
    assert joined(monkeypatch, *apart) == [(1, 1, 0, 90), (2, 3, 90, 30)]


def test_the_number_of_extents_is_limited(monkeypatch):
    monkeypatch.setattr(file_index, "MAX_EXTENTS", 2)
    apart = [(1, 1, 0, 1), (1, 1, 10, 1), (1, 1, 20, 1)]
    assert len(joined(monkeypatch, *apart[:2])) == 2
    with pytest.raises(OverLimitError, match="chunks"):
        joined(monkeypatch, *apart)
