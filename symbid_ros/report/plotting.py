"""Styles, scales, downsampling and SVG output shared by all figures."""

import io
import re
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import PRIOR, TRUTH, ReportContent


def downsample(time: FloatArray, value: FloatArray, points: int) -> tuple[FloatArray, FloatArray]:
    """Downsample a series for a plot; keep the minimum and maximum of each interval.

    Parameters
    ----------
    time, value : (N,) float64
        The series.
    points : int
        Maximum number of samples to keep, two per interval.

    Returns
    -------
    time, value : (M,) float64
        M is at most ``points``; a short series is returned unchanged.
    """
    samples = len(time)
    if samples <= points:
        return time, value
    intervals = points // 2
    length = -(-samples // intervals)
    # The last interval is filled with copies of the last sample, which adds no peak.
    index = np.minimum(np.arange(intervals * length), samples - 1).reshape(intervals, length)
    block = value[index]
    rows = np.arange(intervals)
    extremes = np.stack([index[rows, block.argmin(axis=1)], index[rows, block.argmax(axis=1)]])
    kept = np.unique(extremes)
    return time[kept], value[kept]


INK = "#3a3a3a"
_RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "symbid",
    # Joint names may contain $, which would start a formula.
    "text.parse_math": False,
    "font.size": 8.5,
    "text.color": INK,
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
    """Style of one parameter set; dashes and markers differ as well as colours."""

    colour: str  # from the palette of Okabe and Ito, which colour-blind readers can distinguish
    dash: str  # Matplotlib's line style
    width: float  # line width, points
    marker: str  # Matplotlib's marker


# The truth is a wide dark line below the thin bright line of the estimate: both are visible where
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


def figure_style() -> AbstractContextManager[None]:
    """Return the Matplotlib context in which figures must be created and saved."""
    return rc_context(_RC)  # type: ignore[arg-type]


def styles(content: ReportContent) -> dict[str, Style]:
    """Return the style of each label in the report."""
    labels = [m.label for m in content.methods]
    labels += [s.label for s in content.predictions or ()]
    labels += content.link_errors.percent if content.link_errors else ()
    return assign_styles(labels, prior=PRIOR, chosen=content.chosen)


def assign_styles(labels: Iterable[str], *, prior: str, chosen: str) -> dict[str, Style]:
    """Return the styles of the truth, the prior, the chosen method and all other labels."""
    named = {TRUTH: _TRUTH, prior: _PRIOR, chosen: _CHOSEN}
    others = [label for label in dict.fromkeys(labels) if label not in named]
    return named | {label: _OTHERS[i % len(_OTHERS)] for i, label in enumerate(others)}


def scale_errors(axes: Axes, name: str, values: FloatArray, logarithmic_above: float) -> None:
    """Scale an axis for errors: linear from zero, or logarithmic.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    name : {"x", "y"}
    values : (N,) float64
        The plotted values; a logarithmic axis shows positive finite ones only.
    logarithmic_above : float
        Ratio of the largest to the smallest value above which the axis is logarithmic.
    """
    positive = values[np.isfinite(values) & (values > 0)]
    spread = positive.max() / positive.min() if positive.size else 0.0
    if spread <= logarithmic_above:
        axes.set(**{f"{name}lim": (0, None)})
        return
    axes.set(**{f"{name}scale": "log"})
    axis = axes.xaxis if name == "x" else axes.yaxis
    if spread < 100.0:
        # Whole decades alone would give at most one tick label.
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    else:
        # Labels of more decades would touch each other on phones.
        axis.set_major_locator(LogLocator(numticks=5))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}"))
    # Minor ticks are invisible in this style and take most of the drawing time.
    axis.set_minor_locator(NullLocator())


def colour_variable(colour: str) -> str:
    """Return a colour, such as "#0072b2", as a CSS variable that dark pages set."""
    return _COLOUR.sub(r"var(--c-\1, #\1)", colour)


_XLINK = "{http://www.w3.org/1999/xlink}href"
_COLOUR = re.compile(r"#([0-9a-f]{6})\b")
_LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """Return a figure as an ``<svg>`` element for an HTML page.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Its text stays text.
    name : str
        Unique on the page; prefixes the ids, which all SVGs of a page share.
    description : str
        What the figure shows, for screen readers.
    """
    FigureCanvasSVG(figure)  # measures text for the layout
    fix_layout(figure)
    buffer = io.BytesIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=nothing)
    return embed_svg(buffer.getvalue(), name, description)


def fix_layout(figure: Figure) -> None:
    """Lay out a figure once.

    Saving it would draw it twice, once for the layout; and a second layout would differ by
    rounding and change the file.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def embed_svg(svg: bytes, name: str, description: str) -> str:
    """Return an SVG file written by Matplotlib as an ``<svg>`` element; see `inline_svg`."""
    root = ElementTree.fromstring(svg)
    used = set(re.findall(r'(?:url\(|")#([^)"]+)', ElementTree.tostring(root, encoding="unicode")))
    for element in root.iter():
        _make_local(element, name, used)
    for parent in list(root.iter()):
        for child in list(parent):
            # A style element inside an SVG would apply to the whole page.
            if child.tag in {"style", "metadata"}:
                parent.remove(child)
    root.attrib.pop("width")
    root.attrib.pop("height")
    root.attrib |= {"role": "img", "aria-label": description}
    return ElementTree.tostring(root, encoding="unicode", short_empty_elements=True)


def _make_local(element: ElementTree.Element, name: str, used: set[str]) -> None:
    """Remove namespaces and unused ids, prefix the other ids and shorten coordinates."""
    element.tag = element.tag.rpartition("}")[2]
    element.tail = None
    attributes = element.attrib
    if _XLINK in attributes:
        attributes["href"] = attributes.pop(_XLINK)
    identifier = attributes.pop("id", None)
    if identifier in used:
        attributes["id"] = f"{name}-{identifier}"
    if attributes.get("href", "").startswith("#"):
        attributes["href"] = f"#{name}-{attributes['href'][1:]}"
    if "style" in attributes:
        # A dark page sets the variable.
        attributes["style"] = colour_variable(attributes["style"])
    if "clip-path" in attributes:
        attributes["clip-path"] = attributes["clip-path"].replace("url(#", f"url(#{name}-")
    for key in ("d", "x", "y", "transform"):
        if key in attributes:
            # A hundredth of a point is finer than a pixel of any screen.
            attributes[key] = _LONG_DECIMALS.sub(r"\1", " ".join(attributes[key].split()))
