"""Recover the readable messages of a damaged SQLite file."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
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


class Row(NamedTuple):
    """A message: row number, number of its topic, log time in nanoseconds, payload."""

    number: int
    topic: int
    log_time: int
    payload: bytes


class RowGap(NamedTuple):
    """Rows that cannot be read.

    Attributes
    ----------
    first : int
    stop : int or None
        The next readable row, or None at the end.
    fault : str
    """

    first: int
    stop: int | None
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

    def parts(self) -> Iterator[Row | RowGap]:
        """Yield all readable rows and the gaps between them."""
        position = -LARGEST_ROW
        while position < LARGEST_ROW:
            fault = ""
            try:
                for number, topic, time, payload in self._rows(position):
                    fault = self._fault(number >= position, topic, time, payload)
                    if fault:
                        break
                    yield Row(number, topic, time, payload)
                    position = number + 1
            except apsw.Error as error:
                fault = " ".join(str(error).split())
            if not fault:
                return
            stop = self._next_readable(position)
            yield RowGap(position, stop, fault)
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


@dataclass
class SqliteRecovery:
    """Copies the readable messages of one SQLite file."""

    file: Path
    new: BagRewriter
    counts: RecoveryCounts
    holes: list[LostRange] = field(default_factory=list)

    def run(self) -> None:
        """Copy and count all readable messages of the file."""
        if not self.file.stat().st_size:
            self.counts.holes.append(LostRange(self.file.name, 0, 0, "empty"))
            self.counts.is_counted = False
            return
        warn_of_journals(self.file)
        with open_database(self.file, is_damaged=True) as database:
            registry = read_registry(database)
            _complete_definitions(registry)
            targets = {
                number: self.new.channel(registry, channel)
                for number, channel in registry.channels.items()
            }
            topics = registry.topics
            for topic in topics.values():
                self.counts.stated[topic] += 0
            latest: int | None = None
            for part in DamagedSqliteReader(database, targets).parts():
                if isinstance(part, RowGap):
                    self._report_gap(part, latest)
                    continue
                latest = part.log_time
                self.holes = [h if h.before else replace(h, before=latest) for h in self.holes]
                self.new.write(targets[part.topic], latest, latest, part.payload, sequence=0)
                self.counts.kept[topics[part.topic]] += 1
                self.counts.stated[topics[part.topic]] += 1
        self.counts.holes += self.holes

    def _report_gap(self, gap: RowGap, after: int | None) -> None:
        """Count lost rows; rosbag2 numbers them from 1 without gaps."""
        first = max(gap.first, 1)
        count = 0 if gap.stop is None else max(gap.stop - first, 0)
        last = "the last" if gap.stop is None else f"{gap.stop - 1}"
        self.holes.append(
            LostRange(
                self.file.name,
                0,
                0,
                f"rows {first} to {last}: {gap.fault}",
                after=after,
                messages=count,
                is_counted=gap.stop is not None,
            )
        )
        self.counts.unassigned += count
        self.counts.is_counted &= gap.stop is not None


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
