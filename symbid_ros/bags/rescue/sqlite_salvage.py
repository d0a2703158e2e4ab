"""Rows that can still be read in a damaged SQLite file, and where some cannot."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import apsw

LARGEST_ROW = (1 << 63) - 1


class Row(NamedTuple):
    """A message: row number, topic's number, log time in nanoseconds, payload."""

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
        Next row that can be read; None if there is none.
    fault : str
    """

    first: int
    stop: int | None
    fault: str


@dataclass
class SqliteSalvage:
    """Reads the messages of a file in order of recording, past damaged pages.

    SQLite has no checksums: a changed payload is not noticed.

    Attributes
    ----------
    database : apsw.Connection
    topics : collection of int
        Messages of other topics are damaged.
    """

    database: apsw.Connection
    topics: Collection[int]

    def pieces(self) -> Iterator[Row | RowGap]:
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
            return "a message is no bytes, or its time is invalid"
        return "" if topic in self.topics else "a message's topic was never announced"

    def _next_readable(self, position: int) -> int | None:
        """Return the first readable row behind an unreadable one.

        Steps are doubled until one meets a readable row, then halved: a damaged page makes all
        of its rows unreadable, and only those.
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
        """Return the first row from ``start`` on, or None if it cannot be read or is not there."""
        try:
            for number, topic, time, payload in self._rows(start):
                is_sound = not self._fault(number >= start, topic, time, payload)
                return int(number) if is_sound else None
        except apsw.Error:
            pass
        return None
