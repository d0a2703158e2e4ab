"""The figures of a report: predictions along a motion, errors per link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import TRUTH, LinkErrors, PredictionSeries
from symbid_ros.report.decimation import thin
from symbid_ros.report.numerals import significant
from symbid_ros.report.style import Style
from symbid_ros.report.vector import inline_svg

# Two samples for each pixel column of a panel draw every peak that a screen can show.
POINTS = 800
TORQUES_SHOWN = 6
# Errors that span more than this ratio are drawn on a logarithmic axis.
LOGARITHMIC_ABOVE = 100.0

_PANEL_INCHES = (3.75, 2.05)
_INK = "#3a3a3a"
_RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "symbid",
    # A joint may be called anything, a$b$ too.
    "text.parse_math": False,
    "font.size": 8.5,
    "axes.labelcolor": _INK,
    "axes.edgecolor": "#8a8a8a",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
}


@dataclass(frozen=True)
class Panel:
    """One small figure: heading, ``<svg>`` and the deviations it shows, in words."""

    title: str
    svg: str
    note: str


@dataclass(frozen=True)
class _Quantity:
    """One scalar, as every parameter set predicts it; ``name`` is unique on the page."""

    title: str
    kind: str
    unit: str
    name: str
    values: list[FloatArray]


def com_panels(
    predictions: Sequence[PredictionSeries], styles: dict[str, Style]
) -> tuple[Panel, ...]:
    """Draw the centre of mass in the base frame, one panel for each axis (thesis Fig. 3)."""
    quantities = _axes("CoM", "position", "mm", [1e3 * s.com for s in predictions])
    return tuple(_panel(quantity, predictions, styles) for quantity in quantities)


def torque_panels(
    predictions: Sequence[PredictionSeries],
    joint_names: Sequence[str],
    styles: dict[str, Style],
) -> tuple[Panel, ...]:
    """Draw the joints that carry the largest torques (thesis Fig. 4)."""
    reference = next((s for s in predictions if s.label == TRUTH), predictions[0])
    load = np.sqrt(np.mean(reference.torque**2, axis=0))
    shown = np.sort(np.argsort(-load, kind="stable")[:TORQUES_SHOWN])
    quantities = [
        _Quantity(
            joint_names[j], "torque", "Nm", f"torque-{j}", [s.torque[:, j] for s in predictions]
        )
        for j in shown
    ]
    return tuple(_panel(quantity, predictions, styles) for quantity in quantities)


def momentum_panels(
    predictions: Sequence[PredictionSeries], styles: dict[str, Style]
) -> tuple[Panel, ...]:
    """Draw linear, then angular momentum in world axes (thesis Fig. 5)."""
    quantities = [
        *_axes("Linear", "momentum", "Ns", [s.linear_momentum for s in predictions]),
        *_axes("Angular", "momentum", "Nms", [s.angular_momentum for s in predictions]),
    ]
    return tuple(_panel(quantity, predictions, styles) for quantity in quantities)


def _axes(title: str, kind: str, unit: str, vectors: Sequence[FloatArray]) -> list[_Quantity]:
    return [
        _Quantity(
            f"{title} {axis}", kind, unit, f"{title.lower()}-{axis}", [v[:, i] for v in vectors]
        )
        for i, axis in enumerate("xyz")
    ]


def link_error_panel(errors: LinkErrors, styles: dict[str, Style]) -> Panel:
    """Draw every link's mean relative parameter error, a dot for each method (thesis Fig. 6).

    Dots rather than bars: a bar has no foot on a logarithmic axis, and OLS
    errors reach a thousand times those of the other methods.
    """
    rows = np.arange(len(errors.links), dtype=np.float64)
    labels = list(errors.percent)
    with rc_context(_RC):  # type: ignore[arg-type]
        # Room for the dots of many methods, one below the other.
        height = max(0.27, 0.045 * len(labels))
        figure = Figure(figsize=(6.2, 0.9 + height * len(rows)), layout="constrained")
        axes = figure.add_subplot()
        shift = np.linspace(-0.3, 0.3, len(labels)) if len(labels) > 1 else np.zeros(1)
        for label, offset in zip(labels, shift, strict=True):
            style = styles[label]
            axes.plot(
                errors.percent[label],
                rows + offset,
                linestyle="none",
                marker=style.marker,
                markersize=4.2,
                markeredgewidth=1.2 if style.marker == "|" else 0,
                color=style.colour,
                label=label,
            )
        axes.set_yticks(rows, errors.links)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel("mean relative parameter error [%]")
        positive = np.concatenate([v[v > 0] for v in errors.percent.values()] or [np.zeros(0)])
        if positive.size and positive.max() > LOGARITHMIC_ABOVE * positive.min():
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_xlim(left=0)
        figure.legend(
            loc="outside upper left", ncols=min(4, len(labels)), frameon=False, handletextpad=0.2
        )
        note = f"mean over the links: {_link_means(errors)}"
        title = "Error per link"
        return Panel(title, inline_svg(figure, "error-per-link", f"{title}; {note}"), note)


def _link_means(errors: LinkErrors) -> str:
    return ", ".join(
        f"{label} {significant(float(np.nanmean(values)))} %"
        for label, values in errors.percent.items()
        if np.isfinite(values).any()
    )


def _panel(
    quantity: _Quantity, predictions: Sequence[PredictionSeries], styles: dict[str, Style]
) -> Panel:
    """Draw one quantity over time for every parameter set."""
    with rc_context(_RC):  # type: ignore[arg-type]
        figure = Figure(figsize=_PANEL_INCHES, layout="constrained")
        axes = figure.add_subplot()
        for series, value in zip(predictions, quantity.values, strict=True):
            style = styles[series.label]
            axes.plot(
                *thin(series.time, value, POINTS),
                color=style.colour,
                linestyle=style.dash,
                linewidth=style.width,
                # The truth lies below, whichever order the series come in.
                zorder=2 if series.label == TRUTH else 3,
            )
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{quantity.kind} [{quantity.unit}]")
        axes.margins(x=0)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        note = _deviations(quantity, predictions)
        description = (
            f"{quantity.title}, {quantity.kind} in {quantity.unit} over time. {note}".strip()
        )
        return Panel(quantity.title, inline_svg(figure, quantity.name, description), note)


def _deviations(quantity: _Quantity, predictions: Sequence[PredictionSeries]) -> str:
    """Say how far each series is from the truth, root mean square."""
    values = dict(zip((s.label for s in predictions), quantity.values, strict=True))
    truth = values.pop(TRUTH, None)
    if truth is None or not values:
        return ""
    errors = {label: float(np.sqrt(np.mean((v - truth) ** 2))) for label, v in values.items()}
    return "RMSE: " + ", ".join(
        f"{label} {significant(error)} {quantity.unit}" for label, error in errors.items()
    )
