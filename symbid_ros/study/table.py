"""Tables of values next to the thesis's, as Markdown, as CSV and for the page.

Not pandas data frames: a cell holds a value, the thesis's value and a mark, and pandas is no
dependency of studies.
"""

import csv
import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from symbid_ros.report.formatting import ABSENT, significant

REFERENCE_NOTE = " The second value, if any, is the thesis's, followed by the ratio of ours to it."


@dataclass(frozen=True)
class Cell:
    """One value or a few words.

    Attributes
    ----------
    value : float or None
        Our value, if there is one.
    reference : float or None
        The thesis's value, if it has one.
    text : str
        Shown in place of the value.
    best : bool
        Whether it is the smallest of its group.
    has_ratio : bool
        Whether to show the ratio of ours to the thesis's: useful for errors, but not for
        estimates.
    """

    value: float | None = None
    reference: float | None = None
    text: str = ""
    best: bool = False
    has_ratio: bool = True

    @property
    def display(self) -> str:
        """Our value, rounded for a reader."""
        return self.text or significant(self.value)

    @property
    def ratio(self) -> float | None:
        """Ours over the thesis's; None if one is missing or the thesis's is zero."""
        if not self.has_ratio or self.value is None or not self.reference:
            return None
        return self.value / self.reference

    @property
    def reference_display(self) -> str:
        """The thesis's value and the ratio, empty if the thesis has none."""
        if self.reference is None:
            return ""
        value = significant(self.reference)
        return value if self.ratio is None else f"{value}, ×{significant(self.ratio, 2)}"


@dataclass(frozen=True)
class Column:
    """A column's title and unit; text and counts have no unit."""

    title: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes
    ----------
    labels : tuple of Cell
        What the row is about, such as prior, method and filter.
    cells : tuple of Cell
        One for each column.
    """

    labels: tuple[Cell, ...]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes
    ----------
    name : str
        Stem of its files.
    title, caption : str
        The heading and the sentence below it.
    headings : tuple of Column
        Headers of the labels.
    columns : tuple of Column
        Headers of the cells.
    rows : tuple of Row
        In the order shown.
    notes : tuple of str
        Sentences below the table.
    """

    name: str
    title: str
    caption: str
    headings: tuple[Column, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    @property
    def is_text(self) -> tuple[bool, ...]:
        """Whether each column holds text."""
        return tuple(
            any(row.cells[index].text for row in self.rows) for index in range(len(self.columns))
        )

    @property
    def markdown(self) -> str:
        """The table with heading, caption and notes: best in bold, the thesis's in parentheses."""
        titles = [str(column) for column in (*self.headings, *self.columns)]
        sides = [":--" for _ in self.headings]
        sides += [":--" if is_text else "--:" for is_text in self.is_text]
        lines = [titles, sides]
        lines += [[_markdown_cell(cell) for cell in (*row.labels, *row.cells)] for row in self.rows]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        notes = "\n".join(f"- {note}" for note in self.notes)
        return "\n\n".join(filter(None, (f"## {self.title}", self.caption, table, notes))) + "\n"

    @property
    def csv(self) -> str:
        """The table with all digits, under one line of headers.

        A column with a value of the thesis in any row is followed by two columns: the thesis's
        value, and the ratio of ours to it.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*map(_csv_header, self.headings), *self._csv_headers()])
        for row in self.rows:
            writer.writerow([*map(_csv_cell, row.labels), *self._csv_values(row)])
        return text.getvalue()

    def _csv_headers(self) -> Iterator[str]:
        for index, column in enumerate(self.columns):
            yield _csv_header(column)
            if self._has_reference(index):
                yield _csv_header(Column(f"{column.title} of the thesis", column.unit))
            if self._has_ratio(index):
                yield f"{column.title} ratio"

    def _csv_values(self, row: Row) -> Iterator[str]:
        for index, cell in enumerate(row.cells):
            yield _csv_cell(cell)
            if self._has_reference(index):
                yield _csv_number(cell.reference)
            if self._has_ratio(index):
                yield _csv_number(cell.ratio)

    def _has_reference(self, index: int) -> bool:
        return any(row.cells[index].reference is not None for row in self.rows)

    def _has_ratio(self, index: int) -> bool:
        return any(row.cells[index].ratio is not None for row in self.rows)


def reference_note(rows: Iterable[Row]) -> str:
    """Return the caption's sentence on the thesis's values, empty if no row has any."""
    known = any(cell.reference is not None for row in rows for cell in row.cells)
    return REFERENCE_NOTE if known else ""


def _markdown_cell(cell: Cell) -> str:
    text = cell.display.replace("|", "\\|")
    if cell.best:
        text = f"**{text}**"
    return f"{text} ({cell.reference_display})" if cell.reference_display else text


def _csv_header(column: Column) -> str:
    return f"{column.title} [{column.unit}]" if column.unit else column.title


def _csv_cell(cell: Cell) -> str:
    """Return the value with all digits, or the text of a cell without a value."""
    if cell.value is not None:
        return _csv_number(cell.value)
    return "" if cell.text == ABSENT else cell.text


def _csv_number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else repr(float(value))
