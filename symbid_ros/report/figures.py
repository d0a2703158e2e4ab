"""Figures of a report: predictions along a motion and errors per link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import TRUTH, LinkErrors, PredictionSeries
from symbid_ros.report.formatting import significant
from symbid_ros.report.plotting import Style, downsample, figure_style, inline_svg, scale_errors

POINTS = 800  # two samples per pixel column of a panel show every peak
TORQUES_SHOWN = 6
LOGARITHMIC_ABOVE = 100.0  # ratio of largest to smallest error
_PANEL_INCHES = (3.75, 2.05)


@dataclass(frozen=True)
class PredictedSignal:
    """A scalar signal predicted by every parameter set.

    Attributes
    ----------
    title, kind, unit : str
        Such as "CoM x", "position" and "mm".
    name : str
        Unique on a page.
    values : list of (N,) float64
        One array for each parameter set, in ``unit``.
    """

    title: str
    kind: str
    unit: str
    name: str
    values: list[FloatArray]


def com_signals(predictions: Sequence[PredictionSeries]) -> list[PredictedSignal]:
    """Return the centre of mass in the base frame, x, y and z."""
    return _axes("CoM", "position", "mm", [1e3 * s.com for s in predictions])


def torque_signals(
    predictions: Sequence[PredictionSeries], joint_names: Sequence[str], count: int
) -> list[PredictedSignal]:
    """Return the torques of the ``count`` most loaded joints, in the model's order."""
    reference = next((s for s in predictions if s.label == TRUTH), predictions[0])
    load = np.sqrt(np.mean(reference.torque**2, axis=0))
    shown = np.sort(np.argsort(-load, kind="stable")[:count])
    return [
        PredictedSignal(
            joint_names[j], "torque", "Nm", f"torque-{j}", [s.torque[:, j] for s in predictions]
        )
        for j in shown
    ]


def momentum_signals(predictions: Sequence[PredictionSeries]) -> list[PredictedSignal]:
    """Return linear, then angular momentum in world axes."""
    return [
        *_axes("Linear", "momentum", "Ns", [s.linear_momentum for s in predictions]),
        *_axes("Angular", "momentum", "Nms", [s.angular_momentum for s in predictions]),
    ]


def _axes(title: str, kind: str, unit: str, vectors: Sequence[FloatArray]) -> list[PredictedSignal]:
    return [
        PredictedSignal(
            f"{title} {axis}", kind, unit, f"{title.lower()}-{axis}", [v[:, i] for v in vectors]
        )
        for i, axis in enumerate("xyz")
    ]


def draw(
    axes: Axes,
    signal: PredictedSignal,
    predictions: Sequence[PredictionSeries],
    styles: dict[str, Style],
) -> None:
    """Draw a signal over time for every parameter set; the time axis has no label."""
    for series, value in zip(predictions, signal.values, strict=True):
        style = styles[series.label]
        axes.plot(
            *downsample(series.time, value, POINTS),
            color=style.colour,
            linestyle=style.dash,
            linewidth=style.width,
            # The truth is below all other lines.
            zorder=2 if series.label == TRUTH else 3,
            label=series.label,
        )
    axes.set_ylabel(f"{signal.kind} [{signal.unit}]")
    axes.margins(x=0)
    axes.yaxis.set_major_locator(MaxNLocator(4))


@dataclass(frozen=True)
class Panel:
    """A small figure: heading, ``<svg>`` element and a note on the deviations it shows.

    Of several, some may be left out in print.
    """

    title: str
    svg: str
    note: str
    is_printed: bool = True


def signal_panels(
    signals: Sequence[PredictedSignal],
    predictions: Sequence[PredictionSeries],
    styles: dict[str, Style],
) -> tuple[Panel, ...]:
    """Draw each signal over time for every parameter set (thesis Figs. 3 to 5)."""
    return tuple(_panel(signal, predictions, styles) for signal in signals)


def link_error_panel(errors: LinkErrors, styles: dict[str, Style]) -> Panel:
    """Draw each link's mean relative parameter error, one dot per method (thesis Fig. 6)."""
    note = f"mean over the links: {link_means(errors)}"
    title = "Error per link"
    with figure_style():
        figure = link_error_figure(errors, errors.links, styles, width=4.6)
        return Panel(title, inline_svg(figure, "error-per-link", f"{title}; {note}"), note)


def link_error_figure(
    errors: LinkErrors, names: Sequence[str], styles: dict[str, Style], width: float
) -> Figure:
    """Return a figure with a row of dots for each link, labelled ``names``, and a legend.

    It uses dots because OLS errors reach a thousand times those of other methods, and bars on a
    logarithmic axis have no natural origin.
    """
    rows = np.arange(len(errors.links), dtype=np.float64)
    labels = list(errors.percent)
    # Enough height for the dots of many methods, one below the other.
    height = max(0.27, 0.045 * len(labels))
    figure = Figure(figsize=(width, 0.9 + height * len(rows)), layout="constrained")
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
    axes.set_yticks(rows, names)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel("mean relative parameter error [%]")
    values = np.concatenate([np.zeros(0), *errors.percent.values()])
    scale_errors(axes, "x", values, LOGARITHMIC_ABOVE)
    figure.legend(
        loc="outside upper left",
        ncols=min(4 if width > 5 else 3, len(labels)),
        frameon=False,
        handletextpad=0.2,
    )
    return figure


def link_means(errors: LinkErrors) -> str:
    """List the mean over the links of each parameter set."""
    return ", ".join(
        f"{label} {significant(float(np.nanmean(values)))} %"
        for label, values in errors.percent.items()
        if np.isfinite(values).any()
    )


def _panel(
    signal: PredictedSignal, predictions: Sequence[PredictionSeries], styles: dict[str, Style]
) -> Panel:
    """Draw a signal over time for every parameter set."""
    with figure_style():
        figure = Figure(figsize=_PANEL_INCHES, layout="constrained")
        axes = figure.add_subplot()
        draw(axes, signal, predictions, styles)
        axes.set_xlabel("time [s]")
        note = _deviations(signal, predictions)
        description = f"{signal.title}, {signal.kind} in {signal.unit} over time. {note}".strip()
        return Panel(signal.title, inline_svg(figure, signal.name, description), note)


def _deviations(signal: PredictedSignal, predictions: Sequence[PredictionSeries]) -> str:
    """List the root mean square deviation of each series from the truth."""
    values = dict(zip((s.label for s in predictions), signal.values, strict=True))
    truth = values.pop(TRUTH, None)
    if truth is None or not values:
        return ""
    errors = {label: float(np.sqrt(np.mean((v - truth) ** 2))) for label, v in values.items()}
    return "RMSE: " + ", ".join(
        f"{label} {significant(error)} {signal.unit}" for label, error in errors.items()
    )
