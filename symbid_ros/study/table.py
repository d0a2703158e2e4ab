"""A table of figures, ours beside those of the thesis, as Markdown, CSV and cells of a page."""

import csv
import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from symbid_ros.report.formatting import ABSENT, significant

BESIDE = " Second, where it has one, the thesis's figure and the ratio of ours to it."


@dataclass(frozen=True)
class Cell:
    """One figure or a few words.

    Attributes
    ----------
    value : float or None
        Ours; None where there is none.
    reference : float or None
        The thesis's; None where it has none.
    words : str
        Shown instead of the figure.
    best : bool
        The least of its group.
    rated : bool
        Whether the ratio of ours to the thesis's means anything: of errors it does, of estimates
        it does not.
    """

    value: float | None = None
    reference: float | None = None
    words: str = ""
    best: bool = False
    rated: bool = True

    @property
    def text(self) -> str:
        """Ours, as a reader wants it."""
        return self.words or significant(self.value)

    @property
    def ratio(self) -> float | None:
        """Ours over the thesis's; None where one is missing or the thesis's is zero."""
        if not self.rated or self.value is None or not self.reference:
            return None
        return self.value / self.reference

    @property
    def beside(self) -> str:
        """The thesis's figure and the ratio, empty where the thesis has none."""
        if self.reference is None:
            return ""
        figure = significant(self.reference)
        return figure if self.ratio is None else f"{figure}, ×{significant(self.ratio, 2)}"


@dataclass(frozen=True)
class Column:
    """What a column holds, and in which unit; no unit for words and counts."""

    title: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes
    ----------
    labels : tuple of Cell
        What the line is about, such as prior, method and filter.
    cells : tuple of Cell
        One for each column.
    """

    labels: tuple[Cell, ...]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Sheet:
    """One table.

    Attributes
    ----------
    name : str
        Stem of its files.
    title, caption : str
        The heading and the sentence under it.
    headings : tuple of Column
        Of the labels.
    columns : tuple of Column
        Of the cells.
    rows : tuple of Row
        In the order shown.
    notes : tuple of str
        Sentences under the table.
    """

    name: str
    title: str
    caption: str
    headings: tuple[Column, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    @property
    def worded(self) -> tuple[bool, ...]:
        """Which of the columns hold words."""
        return tuple(
            any(row.cells[index].words for row in self.rows) for index in range(len(self.columns))
        )

    @property
    def markdown(self) -> str:
        """The table with heading, caption and notes; the best in bold, the thesis's in brackets."""
        titles = [str(column) for column in (*self.headings, *self.columns)]
        sides = [":--" for _ in self.headings] + [
            ":--" if worded else "--:" for worded in self.worded
        ]
        lines = [titles, sides]
        lines += [[_marked(cell) for cell in (*row.labels, *row.cells)] for row in self.rows]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        notes = "\n".join(f"- {note}" for note in self.notes)
        return "\n\n".join(filter(None, (f"## {self.title}", self.caption, table, notes))) + "\n"

    @property
    def csv(self) -> str:
        """The table with all digits under one line of headers, no figure rounded.

        What has a figure of the thesis in any row has two more columns: the thesis's, and the
        ratio of ours to it.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*map(_header, self.headings), *self._headers()])
        for row in self.rows:
            writer.writerow([*map(_exact, row.labels), *self._figures(row)])
        return text.getvalue()

    def _headers(self) -> Iterator[str]:
        for index, column in enumerate(self.columns):
            yield _header(column)
            if self._compared(index):
                yield _header(Column(f"{column.title} of the thesis", column.unit))
            if self._rated(index):
                yield f"{column.title} ratio"

    def _figures(self, row: Row) -> Iterator[str]:
        for index, cell in enumerate(row.cells):
            yield _exact(cell)
            if self._compared(index):
                yield _number(cell.reference)
            if self._rated(index):
                yield _number(cell.ratio)

    def _compared(self, index: int) -> bool:
        return any(row.cells[index].reference is not None for row in self.rows)

    def _rated(self, index: int) -> bool:
        return any(row.cells[index].ratio is not None for row in self.rows)


def beside(rows: Iterable[Row]) -> str:
    """Return what a caption says of the thesis's figures, empty where no row has any."""
    known = any(cell.reference is not None for row in rows for cell in row.cells)
    return BESIDE if known else ""


def _header(column: Column) -> str:
    return f"{column.title} [{column.unit}]" if column.unit else column.title


def _marked(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    if cell.best:
        text = f"**{text}**"
    return f"{text} ({cell.beside})" if cell.beside else text


def _exact(cell: Cell) -> str:
    """Return the figure with all its digits, or the words of a cell that has none."""
    if cell.value is not None:
        return _number(cell.value)
    return "" if cell.words == ABSENT else cell.words


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else repr(float(value))
