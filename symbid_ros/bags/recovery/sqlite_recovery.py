"""Recover the readable messages of a damaged SQLite file."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import apsw

from symbid_ros.bags.container.schema_registry import ROS2_TEXT, SchemaRegistry
from symbid_ros.bags.container.sqlite import open_database, read_registry, warn_of_journals
from symbid_ros.bags.recovery.report import LostRange, RecoveryCounts
from symbid_ros.bags.recovery.rewriter import BagRewriter
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition

LARGEST_ROW = (1 << 63) - 1


class StoredRow(NamedTuple):
    """A message: row number, number of its topic, log time in nanoseconds, payload."""

    number: int
    topic: int
    log_time: int
    payload: bytes


class UnreadableRows(NamedTuple):
    """Rows that cannot be read."""

    first: int
    stop: int | None  # the next readable row; None at the end
    fault: str


@dataclass
class DamagedSqliteReader:
    """Reads the messages of a file in order of recording, past damaged pages.

    SQLite has no checksums, so a changed payload is not detected.

    Attributes
    ----------
    database : apsw.Connection
    topics : collection of int
        Known topics; messages of others count as damaged.
    """

    database: apsw.Connection
    topics: Collection[int]

    def parts(self) -> Iterator[StoredRow | UnreadableRows]:
        """Yield all readable rows and the gaps between them."""
        position = -LARGEST_ROW
        while position < LARGEST_ROW:
            fault = ""
            try:
                for number, topic, time, payload in self._rows(position):
                    fault = self._fault(number >= position, topic, time, payload)
                    if fault:
                        break
                    yield StoredRow(number, topic, time, payload)
                    position = number + 1
            except apsw.Error as error:
                fault = " ".join(str(error).split())
            if not fault:
                return
            stop = self._next_readable(position)
            yield UnreadableRows(position, stop, fault)
            if stop is None:
                return
            position = stop

    def _rows(self, start: int) -> apsw.Cursor:
        return self.database.execute(
            "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid >= ? ORDER BY rowid",
            (start,),
        )

    def _fault(self, is_in_order: bool, topic: object, time: object, payload: object) -> str:
        if not is_in_order:
            return "rows are out of order"
        if not isinstance(payload, bytes) or not isinstance(time, int) or time < 0:
            return "a message is not a blob, or its time is invalid"
        return "" if topic in self.topics else "a message's topic was never announced"

    def _next_readable(self, position: int) -> int | None:
        """Return the first readable row after an unreadable one.

        Steps are doubled until a row is readable, then halved. This assumes that a damaged page
        makes all its rows unreadable, and no others.
        """
        start, step = max(position, 0), 1
        while (found := self._readable(start + step)) is None:
            start, step = start + step, 2 * step
            if start + step >= LARGEST_ROW:
                return None
        unreadable, readable = start, start + step
        while readable - unreadable > 1:
            middle = (readable + unreadable) // 2
            if (nearer := self._readable(middle)) is None:
                unreadable = middle
            else:
                readable, found = middle, nearer
        return found

    def _readable(self, start: int) -> int | None:
        """Return the first row from ``start`` on; None if it is unreadable or does not exist."""
        try:
            for number, topic, time, payload in self._rows(start):
                is_sound = not self._fault(number >= start, topic, time, payload)
                return int(number) if is_sound else None
        except apsw.Error:
            pass
        return None


def recover_sqlite(file: Path, new: BagRewriter, counts: RecoveryCounts) -> None:
    """Copy and count the readable messages of an SQLite file."""
    warn_of_journals(file)
    with open_database(file, is_damaged=True) as database:
        registry = read_registry(database)
        _complete_definitions(registry)
        targets = {
            number: new.channel(registry, channel) for number, channel in registry.channels.items()
        }
        topics = registry.topics
        for topic in topics.values():
            counts.stated[topic] += 0
        for part in DamagedSqliteReader(database, targets).parts():
            if isinstance(part, UnreadableRows):
                _report_gap(file, part, counts)
                continue
            new.write(targets[part.topic], part.log_time, part.log_time, part.payload, sequence=0)
            counts.add_kept_times(part.log_time, part.log_time)
            counts.kept[topics[part.topic]] += 1
            counts.stated[topics[part.topic]] += 1


def _report_gap(file: Path, gap: UnreadableRows, counts: RecoveryCounts) -> None:
    """Count lost rows; rosbag2 numbers them from 1 without gaps."""
    first = max(gap.first, 1)
    count = 0 if gap.stop is None else max(gap.stop - first, 0)
    last = "the last" if gap.stop is None else f"{gap.stop - 1}"
    is_counted = gap.stop is not None
    fault = f"rows {first} to {last}: {gap.fault}"
    counts.add_hole(LostRange(file.name, 0, 0, fault, messages=count, is_counted=is_counted))
    counts.unassigned += count
    counts.is_counted &= is_counted


def _complete_definitions(registry: SchemaRegistry) -> None:
    """Add the definitions of known types, which SQLite bags lack before Jazzy."""
    for number, schema in registry.schemas.items():
        if schema.data:
            continue
        try:
            definition = find_definition(schema.name)
        except BagError:
            continue
        schema.encoding, schema.data = ROS2_TEXT, definition.text.encode()
        metadata = registry.channels[number].metadata
        metadata["topic_type_hash"] = metadata["topic_type_hash"] or definition.type_hash
