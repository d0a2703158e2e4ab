"""Figures with captions, written as files and embedded in the page."""

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
from symbid_ros.report.plotting import Style, assign_styles, embed_svg, figure_style, fix_layout
from symbid_ros.study.scores import REFERENCE
from symbid_ros.study.thesis import TITLES

WIDTH = 3.75  # inches, the width of a phone's page, on which no text is scaled down
DPI = 200

_CHOSEN = "WLS-RC"
# In this order, so that a method has the same style whichever methods a figure shows.
_OTHERS = ("MAP-LMI", "WLS-R", "WLS-C", "MAP", "OLS")


@dataclass(frozen=True)
class CaptionedFigure:
    """A figure of a study.

    Attributes
    ----------
    name : str
        Stem of its files; unique within a study.
    title : str
        Heading, with the number of the thesis's figure if it has one.
    caption : str
        What the figure shows, for which data, and its main numbers.
    figure : matplotlib.figure.Figure
        With a fixed layout.
    description : str
        Text for screen readers.
    """

    name: str
    title: str
    caption: str
    figure: Figure
    description: str

    @cached_property
    def svg(self) -> bytes:
        """The figure as an SVG file, whose text stays text."""
        return self._rendered("svg", {"Creator": None, "Date": None})

    def _rendered(self, kind: str, metadata: dict[str, None]) -> bytes:
        about = {"Title": self.title, "Description": self.description}
        buffer = io.BytesIO()
        with figure_style():
            self.figure.savefig(buffer, format=kind, dpi=DPI, metadata={**about, **metadata})
        return buffer.getvalue()

    def save(self, folder: Path) -> tuple[Path, Path]:
        """Write NAME.svg and NAME.png; equal figures give equal files.

        Returns
        -------
        svg, png : Path

        Raises
        ------
        SymbidError
            If a file cannot be written.
        """
        svg, png = folder / f"{self.name}.svg", folder / f"{self.name}.png"
        write_through(svg, lambda stream: stream.write(self.svg))
        pixels = self._rendered("png", {"Software": None})
        write_through(png, lambda stream: stream.write(pixels))
        return svg, png

    def embedded(self) -> str:
        """Return the figure as an ``<svg>`` element whose ids are unique on the page."""
        return embed_svg(self.svg, self.name, self.description)


@contextmanager
def stacked_panels(
    count: int, panel_height: float, *, other_height: float, share_x: bool = True
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Create a column of panels, and fix their layout at the end of the ``with`` block.

    Parameters
    ----------
    count : int
        Number of panels.
    panel_height, other_height : float
        Height of each panel, and of the legend and the last axis together, inches.
    share_x : bool
        Whether only the last panel has ticks along x.
    """
    with figure_style():
        size = WIDTH, count * panel_height + other_height
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(count, 1, sharex=share_x, squeeze=False)[:, 0].tolist()
        yield figure, panels
        figure.align_ylabels(panels)
        fix_layout(figure)


def label_styles(labels: Iterable[str]) -> dict[str, Style]:
    """Return the styles of labels, in their order; a method has the same in every figure."""
    shown = list(labels)
    known = assign_styles([*_OTHERS, *shown], prior=TITLES[REFERENCE], chosen=_CHOSEN)
    return {label: known[label] for label in shown}


def marker_options(style: Style, *, hollow: bool = False) -> dict[str, Any]:
    """Return Matplotlib's options for a method's markers, hollow for the thesis's values."""
    thin = style.marker == "|" or hollow
    return {
        "marker": style.marker,
        "markersize": 5.4 if hollow else 4.4,
        "color": style.colour,
        "markerfacecolor": "none" if hollow else style.colour,
        "markeredgewidth": 0.9 if thin else 0.0,
    }


def line_options(style: Style) -> dict[str, Any]:
    """Return Matplotlib's options for a method's line."""
    return {"color": style.colour, "linestyle": style.dash, "linewidth": style.width}


def add_legend(figure: Figure, entries: dict[str, dict[str, Any]], columns: int = 4) -> None:
    """Add a legend above the panels; an entry maps a label to Matplotlib's line options."""
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
