"""Tables of values next to the thesis's, as Markdown, as CSV and for the page.

They are not pandas data frames, as a cell also holds the thesis's value and whether it is the best.
"""

import csv
import io
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from symbid_ros.report.formatting import ABSENT, significant

REFERENCE_NOTE = " The second value, if any, is the thesis's, followed by the ratio of ours to it."


@dataclass(frozen=True)
class Cell:
    """One value, or a text.

    Attributes
    ----------
    value, reference : float or None
        Our value and the thesis's, if they exist.
    text : str
        Shown instead of the value.
    best : bool
        Whether the value is the smallest of its group.
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


def text_cells(*texts: str) -> tuple[Cell, ...]:
    """Return a cell for each text."""
    return tuple(Cell(text=text) for text in texts)


@dataclass(frozen=True)
class Column:
    """A column's title and unit; text and counts have no unit."""

    title: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


@dataclass(frozen=True)
class TableRow:
    """A row: its labels, such as prior, method and filter, and a cell for each column."""

    labels: tuple[Cell, ...]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """A table of a study.

    Attributes
    ----------
    name : str
        Stem of its files.
    title, caption : str
        The heading and the sentence below it.
    headings, columns : tuple of Column
        Headers of the labels and of the cells.
    rows : tuple of TableRow
        In the order shown.
    notes : tuple of str
        Sentences below the table.
    """

    name: str
    title: str
    caption: str
    headings: tuple[Column, ...]
    columns: tuple[Column, ...]
    rows: tuple[TableRow, ...]
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

        A column for which the thesis has values is followed by two columns: the thesis's value,
        and the ratio of ours to it.
        """
        columns = [
            [_csv_header(heading), *(_csv_cell(row.labels[index]) for row in self.rows)]
            for index, heading in enumerate(self.headings)
        ]
        for index, column in enumerate(self.columns):
            cells = [row.cells[index] for row in self.rows]
            columns.append([_csv_header(column), *map(_csv_cell, cells)])
            if any(cell.reference is not None for cell in cells):
                header = _csv_header(Column(f"{column.title} of the thesis", column.unit))
                columns.append([header, *(_csv_number(cell.reference) for cell in cells)])
            if any(cell.ratio is not None for cell in cells):
                header = f"{column.title} ratio"
                columns.append([header, *(_csv_number(cell.ratio) for cell in cells)])
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(zip(*columns, strict=True))
        return text.getvalue()


def reference_note(rows: Iterable[TableRow]) -> str:
    """Return the caption's sentence on the thesis's values, empty if no row has any."""
    known = any(cell.reference is not None for row in rows for cell in row.cells)
    return REFERENCE_NOTE if known else ""


def file_stem(text: str) -> str:
    """Return a text with only the characters that file names and ids may have."""
    return re.sub(r"[^\w.+-]", "", text.replace("%", "percent").replace(" ", "_"))


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
