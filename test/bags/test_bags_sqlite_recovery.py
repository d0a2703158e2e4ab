"""Readable rows around damaged ones, where each kind of damage is known."""

import apsw
import pytest

from symbid_ros.bags.recovery.report import RecoveryCounts
from symbid_ros.bags.recovery.sqlite_recovery import (
    LARGEST_ROW,
    DamagedSqliteReader,
    StoredRow,
    UnreadableRows,
    _report_gap,
)


class Database:
    """Rows 1 to ``count`` in order; reading an unreadable one fails, as on a damaged page."""

    def __init__(self, count, unreadable=(), rows=()):
        self.rows = {n: (n, 1, 10 * n, b"%d" % n) for n in range(1, count + 1)} | dict(rows)
        self.unreadable = frozenset(unreadable)
        self.reads = 0

    def execute(self, _, values):
        for number in sorted(self.rows):
            if number >= values[0]:
                self.reads += 1
                if number in self.unreadable:
                    raise apsw.CorruptError("malformed  page")
                yield self.rows[number]


def parts(database):
    return list(DamagedSqliteReader(database, {1, 2}).parts())


def test_intact_rows_are_read_in_order():
    assert parts(Database(0)) == []
    found = parts(Database(3))
    assert found == [StoredRow(n, 1, 10 * n, b"%d" % n) for n in (1, 2, 3)]


@pytest.mark.parametrize("count", [1, 2, 3, 7, 64, 100])
@pytest.mark.parametrize("first", [1, 2, 33])
def test_only_damaged_rows_are_left_out(count, first):
    """Any number of rows on damaged pages, anywhere in the file."""
    database = Database(200, range(first, first + count))
    found = parts(database)
    (gap,) = (part for part in found if isinstance(part, UnreadableRows))
    place = found.index(gap)
    assert gap.stop == first + count
    assert gap.first == (first if first > 1 else -LARGEST_ROW)
    assert gap.fault == "malformed page"
    kept = [part.number for part in found[:place] + found[place + 1 :]]
    assert kept == [n for n in range(1, 201) if not first <= n < first + count]
    # Doubled and halved steps: few reads for many rows.
    assert database.reads < 200 + 4 * count.bit_length() + 8


def test_several_gaps_are_reported_one_by_one():
    gaps = [part for part in parts(Database(60, [5, 6, 20])) if isinstance(part, UnreadableRows)]
    assert [(gap.first, gap.stop) for gap in gaps] == [(5, 7), (20, 21)]


def test_a_file_damaged_up_to_its_end_has_no_further_row():
    found = parts(Database(30, range(10, 31)))
    assert found[-1] == UnreadableRows(10, None, "malformed page")
    assert len(found) == 10
    # Rows that do not exist are as good as unreadable ones.
    assert parts(Database(30, [30]))[-1] == UnreadableRows(30, None, "malformed page")


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ((5, 3, 50, b""), "topic was never announced"),
        ((5, 1, 50, "text"), "not a blob"),
        ((5, 1, -1, b""), "time is invalid"),
        ((5, 1, "late", b""), "time is invalid"),
        ((4, 1, 50, b""), "out of order"),
    ],
)
def test_rows_with_invalid_values_are_left_out(row, fault):
    found = parts(Database(9, rows={5: row}))
    (gap,) = (part for part in found if isinstance(part, UnreadableRows))
    assert (gap.first, gap.stop) == (5, 6)
    assert fault in gap.fault
    assert [part.number for part in found if part is not gap] == [1, 2, 3, 4, 6, 7, 8, 9]


def test_a_row_may_have_the_time_zero_and_no_content():
    assert parts(Database(0, rows={7: (7, 2, 0, b"")})) == [StoredRow(7, 2, 0, b"")]


@pytest.mark.parametrize(
    ("gap", "messages", "says"),
    [
        (UnreadableRows(5, 9, "bad"), 4, "rows 5 to 8: bad"),
        (UnreadableRows(-LARGEST_ROW, 4, "bad"), 3, "rows 1 to 3: bad"),
        (UnreadableRows(-LARGEST_ROW, 1, "bad"), 0, "rows 1 to 0: bad"),
        (UnreadableRows(-LARGEST_ROW, -3, "bad"), 0, "rows 1 to -4: bad"),
        (UnreadableRows(5, None, "bad"), 0, "rows 5 to the last: bad"),
    ],
)
def test_lost_rows_are_counted_from_the_first(tmp_path, gap, messages, says):
    counts = RecoveryCounts(unassigned=10)
    _report_gap(tmp_path / "log.db3", gap, counts)
    (hole,) = counts.holes
    assert (hole.file, hole.fault, hole.messages) == ("log.db3", says, messages)
    assert (hole.offset, hole.length) == (0, 0)
    assert hole.is_counted is counts.is_counted is (gap.stop is not None)
    assert counts.unassigned == 10 + messages
