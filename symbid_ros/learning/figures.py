"""Figures of a robot that learns: errors, feed-forward, deviations, and what happened when."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from symbid_ros.arrays import FloatArray
from symbid_ros.learning.lockstep import LearningRecord
from symbid_ros.learning.model_update import ACCEPTED
from symbid_ros.report.plotting import figure_style

ALONE, LEARNING, TRUE = "file alone", "learning", "true model"
COLOURS = {ALONE: "#d55e00", LEARNING: "#0072b2", TRUE: "#3a3a3a"}
WINDOW = 1.0  # s, over which errors and shares are taken
SIZE = (5.0, 2.4)  # inches


@dataclass(frozen=True)
class LearningFigure:
    """A figure over time.

    Attributes
    ----------
    name, title, description : str
        File name without suffix, heading, and what is drawn.
    figure : matplotlib.figure.Figure
    """

    name: str
    title: str
    description: str
    figure: Figure


def learning_figures(runs: Mapping[str, LearningRecord]) -> tuple[LearningFigure, ...]:
    """Draw the runs: tracking error, feed-forward share, and deviations with the size of moves.

    Parameters
    ----------
    runs : mapping of str to LearningRecord
        By label, with one that learns.
    """
    with figure_style():
        return (
            LearningFigure(
                "com_error",
                "Tracking error of the centre of mass",
                f"Distance of the true centre of mass from its reference, rms over {WINDOW:g} s. "
                "Vertical lines: a model is taken over (solid), an event of another kind (dotted).",
                _curves(runs, "com_error", "error, mm", 1e3),
            ),
            LearningFigure(
                "feed_forward",
                "Feed-forward share of the torques",
                "One minus the ratio of feedback to total torque, rms over "
                f"{WINDOW:g} s and all drives.",
                _curves(runs, "feed_forward_share", "share, %", 1e2),
            ),
            LearningFigure(
                "deviations",
                "What the robot knows, and how far it moves",
                "Standard deviations of the whole robot's mass and centre of mass, from the "
                "covariance of all parameters, for sensors without an error in common, and the "
                "size of the moves that they allow.",
                _deviations(runs[LEARNING]),
            ),
        )


def _curves(runs: Mapping[str, LearningRecord], name: str, unit: str, factor: float) -> Figure:
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
    for label, record in runs.items():
        time, values = _windowed(record, name)
        colour = COLOURS[label]
        # The truth is a wide line below the thin one of the robot that learns.
        width, order = (2.8, 2) if label == TRUE else (1.2, 3)
        axes.plot(time, factor * values, color=colour, label=label, linewidth=width, zorder=order)
        if record.fall is not None and len(time):
            axes.plot(time[-1], factor * values[-1], "x", color=colour, markersize=7)
            axes.annotate(
                f"falls at {record.fall.time:.1f} s",
                (time[-1], factor * values[-1]),
                textcoords="offset points",
                xytext=(7, -3),
                color=colour,
            )
    axes.set(xlabel="time, s", ylabel=unit)
    if name == "com_error":
        axes.set_ylim(0, None)
    _mark(axes, runs[LEARNING])
    _legend(figure, axes)
    return figure


def _windowed(record: LearningRecord, name: str) -> tuple[FloatArray, FloatArray]:
    """Return the ends of windows (s) and a value for each."""
    measure = getattr(record, name)
    last = float(record.time[-1])
    ends = np.arange(WINDOW, last + WINDOW / 4, WINDOW / 4)
    return ends, np.array([measure(end - WINDOW, end) for end in ends.tolist()])


def _deviations(record: LearningRecord) -> Figure:
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
    time = [known.time for known in record.estimates]
    colour = COLOURS[LEARNING]
    axes.semilogy(
        time, [1e3 * known.com_std for known in record.estimates], color=colour, linewidth=1.3
    )
    axes.semilogy(
        time,
        [1e3 * known.mass_std for known in record.estimates],
        color="#009e73",
        linestyle="-.",
        linewidth=1.3,
    )
    axes.plot([], [], color=colour, label="centre of mass, mm")
    axes.plot([], [], color="#009e73", linestyle="-.", label="mass, g")
    axes.plot([], [], color="#8f8f8f", linestyle="--", label="size of moves, %")
    axes.set(xlabel="time, s", ylabel="deviation")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    size = axes.twinx()
    size.plot(record.time, 100 * record.reach, color="#8f8f8f", linestyle="--", linewidth=1.2)
    size.set(ylabel="size of moves, %", ylim=(0, 105))
    size.grid(visible=False)
    _mark(axes, record)
    _legend(figure, axes)
    return figure


def _legend(figure: Figure, axes: Axes) -> None:
    figure.legend(
        *axes.get_legend_handles_labels(), frameon=False, ncols=3, loc="outside upper center"
    )


def _mark(axes: Axes, record: LearningRecord) -> None:
    """Draw a line at each model that was taken over, and at each refusal, payload and change."""
    for event in record.events:
        is_accepted = event.kind == ACCEPTED
        axes.axvline(
            event.time,
            color=COLOURS[LEARNING] if is_accepted else "#cc79a7",
            linestyle="-" if is_accepted else ":",
            linewidth=0.6,
            zorder=1,
        )
        if not is_accepted:
            axes.annotate(
                event.kind,
                (event.time, 0.02),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=7,
                color="#8a8a8a",
            )
