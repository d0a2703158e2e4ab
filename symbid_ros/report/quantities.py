"""The scalars of a prediction that figures show over time, and how they are drawn."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import TRUTH, PredictionSeries
from symbid_ros.report.decimation import thin
from symbid_ros.report.style import Style

# Two samples for each pixel column of a panel draw every peak that a screen can show.
POINTS = 800


@dataclass(frozen=True)
class Quantity:
    """One scalar, as every parameter set predicts it.

    Attributes
    ----------
    title, kind, unit : str
        Such as "CoM x", "position" and "mm".
    name : str
        Unique on a page.
    values : list of (N,) float64
        One for each parameter set, in ``unit``.
    """

    title: str
    kind: str
    unit: str
    name: str
    values: list[FloatArray]


def com_quantities(predictions: Sequence[PredictionSeries]) -> list[Quantity]:
    """Return the centre of mass in the base frame, x, y and z."""
    return _axes("CoM", "position", "mm", [1e3 * s.com for s in predictions])


def torque_quantities(
    predictions: Sequence[PredictionSeries], joint_names: Sequence[str], count: int
) -> list[Quantity]:
    """Return the torques of the ``count`` joints that carry most, in the model's order."""
    reference = next((s for s in predictions if s.label == TRUTH), predictions[0])
    load = np.sqrt(np.mean(reference.torque**2, axis=0))
    shown = np.sort(np.argsort(-load, kind="stable")[:count])
    return [
        Quantity(
            joint_names[j], "torque", "Nm", f"torque-{j}", [s.torque[:, j] for s in predictions]
        )
        for j in shown
    ]


def momentum_quantities(predictions: Sequence[PredictionSeries]) -> list[Quantity]:
    """Return linear, then angular momentum in world axes."""
    return [
        *_axes("Linear", "momentum", "Ns", [s.linear_momentum for s in predictions]),
        *_axes("Angular", "momentum", "Nms", [s.angular_momentum for s in predictions]),
    ]


def _axes(title: str, kind: str, unit: str, vectors: Sequence[FloatArray]) -> list[Quantity]:
    return [
        Quantity(
            f"{title} {axis}", kind, unit, f"{title.lower()}-{axis}", [v[:, i] for v in vectors]
        )
        for i, axis in enumerate("xyz")
    ]


def draw(
    axes: Axes,
    quantity: Quantity,
    predictions: Sequence[PredictionSeries],
    styles: dict[str, Style],
) -> None:
    """Draw one quantity over time for every parameter set; the time axis is left unlabelled."""
    for series, value in zip(predictions, quantity.values, strict=True):
        style = styles[series.label]
        axes.plot(
            *thin(series.time, value, POINTS),
            color=style.colour,
            linestyle=style.dash,
            linewidth=style.width,
            # The truth lies below, whichever order the series come in.
            zorder=2 if series.label == TRUTH else 3,
            label=series.label,
        )
    axes.set_ylabel(f"{quantity.kind} [{quantity.unit}]")
    axes.margins(x=0)
    axes.yaxis.set_major_locator(MaxNLocator(4))
