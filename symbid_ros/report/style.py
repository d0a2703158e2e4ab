"""Colours, dashes, markers, type and scales that mean the same in every figure."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import PRIOR, TRUTH, ReportContent

INK = "#3a3a3a"
_RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "symbid",
    # A joint may be called anything, a$b$ too.
    "text.parse_math": False,
    "font.size": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#8a8a8a",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
}


@dataclass(frozen=True)
class Style:
    """How one parameter set is drawn; colour is never the only sign.

    Attributes
    ----------
    colour : str
        From the palette of Okabe and Ito, which colour-blind readers tell apart.
    dash : str
        Matplotlib's line style.
    width : float
        Line width, points.
    marker : str
        Matplotlib's marker.
    """

    colour: str
    dash: str
    width: float
    marker: str


# The truth lies wide and dark below, the estimate thin and bright on it: both stay visible where
# they agree.
_TRUTH = Style("#3a3a3a", "-", 2.6, "|")
_PRIOR = Style("#8f8f8f", "--", 1.2, "s")
_CHOSEN = Style("#0072b2", "-", 1.1, "o")
_OTHERS = (
    Style("#d55e00", "-.", 1.1, "^"),
    Style("#b07c00", ":", 1.2, "v"),
    Style("#009e73", "-.", 1.1, "D"),
    Style("#cc79a7", ":", 1.2, "P"),
    Style("#56b4e9", "-.", 1.1, "X"),
    Style("#000000", ":", 1.1, "*"),
)


def house_style() -> AbstractContextManager[None]:
    """Return the context in which figures are made, and in which they are written too."""
    return rc_context(_RC)  # type: ignore[arg-type]


def styles(content: ReportContent) -> dict[str, Style]:
    """Return the style of every label that occurs in the report."""
    labels = [m.label for m in content.methods]
    labels += [s.label for s in content.predictions or ()]
    labels += content.link_errors.percent if content.link_errors else ()
    return assigned(labels, prior=PRIOR, chosen=content.chosen)


def assigned(labels: Iterable[str], *, prior: str, chosen: str) -> dict[str, Style]:
    """Return a style for the truth, the prior, the chosen method, and each other label in turn."""
    named = {TRUTH: _TRUTH, prior: _PRIOR, chosen: _CHOSEN}
    others = [label for label in dict.fromkeys(labels) if label not in named]
    return named | {label: _OTHERS[i % len(_OTHERS)] for i, label in enumerate(others)}


def scale_errors(axes: Axes, name: str, values: FloatArray, logarithmic_above: float) -> None:
    """Scale axis ``name``, x or y, for errors: from zero, or logarithmic.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    name : {"x", "y"}
    values : (N,) float64
        What is drawn; those not positive and finite have no place on a logarithmic axis.
    logarithmic_above : float
        Ratio of the largest to the smallest from which on the axis is logarithmic.
    """
    positive = values[np.isfinite(values) & (values > 0)]
    spread = positive.max() / positive.min() if positive.size else 0.0
    if spread <= logarithmic_above:
        axes.set(**{f"{name}lim": (0, None)})
        return
    axes.set(**{f"{name}scale": "log"})
    axis = axes.xaxis if name == "x" else axes.yaxis
    if spread < 100.0:
        # Of whole decades alone there would be one or none to read.
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}"))
    # Between decades they would not be seen, and take most of the time.
    axis.set_minor_locator(NullLocator())
