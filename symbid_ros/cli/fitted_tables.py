"""Tables that keep names and numbers whole on a narrow terminal, by continuing below."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path

from rich.box import SIMPLE_HEAD, Box
from rich.console import Console
from rich.table import Table
from rich.text import Text

Row = tuple[str, Sequence[Text | str]] | None  # name and cells; None: a line between groups of rows
UNLIMITED = 10_000  # columns of a terminal
LEAST_NAME = 12  # characters of a name in one line of a cell


def written_files(out: Path, names: Iterable[str]) -> Text:
    """Return a line that names the files written to a folder."""
    return Text(f"wrote {str(out).rstrip('/')}/: {', '.join(names)}")


def print_table(
    console: Console,
    first: str,
    groups: Sequence[Sequence[str]],
    rows: Sequence[Row],
    *,
    title: str | None = None,
    style: Box = SIMPLE_HEAD,
) -> None:
    """Print a table of numbers, in several parts if the terminal is too narrow for all columns.

    Parameters
    ----------
    console : Console
    first : str
        Header of the column of names.
    groups : sequence of sequences of str
        Headers of the other columns. A table that does not fit is divided between groups first.
    rows : sequence of Row
    title : str, optional
        Above the first part.
    style : Box
    """
    names = max([len(first), *(len(row[0]) for row in rows if row is not None)])
    width = names
    headers = [header for group in groups for header in group]

    def part(start: int, stop: int, *, is_dense: bool) -> Table:
        is_padded = style is not SIMPLE_HEAD
        table = Table(box=style, pad_edge=is_padded, collapse_padding=is_dense)
        # Rich pads the first column on both sides, but measures one side of a dense table.
        table.add_column(first, width=width + (is_padded and is_dense), overflow="fold")
        for header in headers[start:stop]:
            table.add_column(header, justify="right", no_wrap=True)
        for row in rows:
            if row is None:
                table.add_section()
            else:
                table.add_row(Text(row[0]), *row[1][start:stop])
        return table

    def fits(start: int, stop: int, *, is_dense: bool = False) -> bool:
        options = console.options.update(max_width=UNLIMITED)
        table = part(start, stop, is_dense=is_dense)
        return console.measure(table, options=options).maximum <= console.width

    if title is not None:
        console.print(Text(title, style="italic"), soft_wrap=True)
    whole = 0, len(headers)
    ends = list(accumulate(map(len, groups), initial=0))
    # Names break only where a group would not fit beside them.
    if not (fits(*whole, is_dense=True) or all(fits(*pair) for pair in pairwise(ends))):
        width = min(names, max(LEAST_NAME, console.width // 3))
    if fits(*whole) or fits(*whole, is_dense=True):
        console.print(part(*whole, is_dense=not fits(*whole)))
        return
    start = 0
    for group in groups:
        for length in _balanced(start, len(group), fits):
            console.print(part(start, start + length, is_dense=False))
            start += length


def _balanced(start: int, size: int, fits: Callable[[int, int], bool]) -> Iterator[int]:
    """Yield the lengths of the fewest parts that fit, as equal as possible."""
    for count in range(1, size + 1):
        stops = [start + round(size * index / count) for index in range(count + 1)]
        if count == size or all(fits(*ends) for ends in pairwise(stops)):
            yield from (stop - begin for begin, stop in pairwise(stops))
            return
