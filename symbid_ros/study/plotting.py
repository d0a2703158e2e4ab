"""A figure with its caption: as files, and as a part of a page."""

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from symbid_ros.atomic_write import write_through
from symbid_ros.report.plotting import Style, assign_styles, embed_svg, house_style
from symbid_ros.study.scores import REFERENCE
from symbid_ros.study.thesis import TITLES

LABELS = TITLES
REF = TITLES[REFERENCE]  # as the thesis calls the prior
WIDTH = 3.75  # inches, as a phone's page: on it no text shrinks
DPI = 200

_CHOSEN = "WLS-RC"
# Whatever methods a figure shows, each looks the same in all of them.
_OTHERS = ("MAP-LMI", "WLS-R", "WLS-C", "MAP", "OLS")


@dataclass(frozen=True)
class Drawing:
    """A figure of a study.

    Attributes
    ----------
    name : str
        Stem of its files; unique within a study.
    title : str
        With the thesis's number, where it has such a figure.
    caption : str
        What is shown, of what, and the numbers that belong to it.
    figure : matplotlib.figure.Figure
        Laid out.
    description : str
        What is seen, for those who hear the page.
    """

    name: str
    title: str
    caption: str
    figure: Figure
    description: str

    @cached_property
    def svg(self) -> bytes:
        """The figure as a file of its own."""
        return self.rendered("svg", {"Creator": None, "Date": None})

    def rendered(self, kind: str, metadata: dict[str, None]) -> bytes:
        """Return the figure in a file format, title and description with it."""
        about = {"Title": self.title, "Description": self.description}
        buffer = io.BytesIO()
        with house_style():
            self.figure.savefig(buffer, format=kind, dpi=DPI, metadata={**about, **metadata})
        return buffer.getvalue()


def save(drawing: Drawing, folder: Path) -> tuple[Path, Path]:
    """Write NAME.svg, whose text is text, and NAME.png of 200 dpi, each in one step.

    The same drawing makes the same bytes, whenever it is written.

    Returns
    -------
    svg, png : Path

    Raises
    ------
    SymbidError
        When the folder cannot be written to.
    """
    svg, png = folder / f"{drawing.name}.svg", folder / f"{drawing.name}.png"
    write_through(svg, lambda stream: stream.write(drawing.svg))
    pixels = drawing.rendered("png", {"Software": None})
    write_through(png, lambda stream: stream.write(pixels))
    return svg, png


def inline(drawing: Drawing) -> str:
    """Return the figure as an ``<svg>`` whose ids are its own on a page with others."""
    return embed_svg(drawing.svg, drawing.name, drawing.description)


@contextmanager
def stack(
    count: int, panel_height: float, *, other_height: float, share_x: bool = True
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure of panels one below the other, and lay it out when they are filled.

    Parameters
    ----------
    count : int
        Number of panels.
    panel_height, other_height : float
        Inches for each panel, and for legend and last axis together.
    share_x : bool
        Whether only the last panel has ticks along x.
    """
    with house_style():
        size = WIDTH, count * panel_height + other_height
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(count, 1, sharex=share_x, squeeze=False)[:, 0].tolist()
        yield figure, panels
        figure.align_ylabels(panels)
        settle(figure)


def settle(figure: Figure) -> None:
    """Lay a figure out for good: once more, it would move by rounding and make other bytes."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def looks(labels: Iterable[str]) -> dict[str, Style]:
    """Return the styles of labels, in their order; a method's is the same in every figure."""
    wanted = list(labels)
    known = assign_styles([*_OTHERS, *wanted], prior=REF, chosen=_CHOSEN)
    return {label: known[label] for label in wanted}


def marks(style: Style, *, hollow: bool = False) -> dict[str, Any]:
    """Return Matplotlib's options for a method's markers; hollow ones are the thesis's."""
    thin = style.marker == "|" or hollow
    return {
        "marker": style.marker,
        "markersize": 5.4 if hollow else 4.4,
        "color": style.colour,
        "markerfacecolor": "none" if hollow else style.colour,
        "markeredgewidth": 0.9 if thin else 0.0,
    }


def curve(style: Style) -> dict[str, Any]:
    """Return Matplotlib's options for a method's line."""
    return {"color": style.colour, "linestyle": style.dash, "linewidth": style.width}


def legend(figure: Figure, entries: dict[str, dict[str, Any]], columns: int = 4) -> None:
    """Put a legend above all panels, an entry for each label's options of a line."""
    handles = [Line2D([], [], label=label, **entry) for label, entry in entries.items()]
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=min(columns, len(handles)),
        frameon=False,
        handlelength=1.9,
        handletextpad=0.4,
        columnspacing=1.1,
    )
