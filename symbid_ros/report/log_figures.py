"""Figures of a real log: forces and errors over time, error spectra, errors against the speed."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.identification.report_data import Coverage, ForceSeries, ReportData
from symbid_ros.report.figures import Panel
from symbid_ros.report.formatting import significant
from symbid_ros.report.plotting import Style, downsample, figure_style, inline_svg

MEASURED, ORIGINAL, IDENTIFIED = "measured", "original model", "identified model"
# The measured force is a wide line below the thin ones of the models. Among errors, that of the
# original model is a wide line below the thin one of the identified model, which may be equal.
STYLES = {
    MEASURED: Style("#3a3a3a", "-", 2.2, "|"),
    ORIGINAL: Style("#d55e00", "-", 0.9, "^"),
    IDENTIFIED: Style("#0072b2", "-", 1.1, "o"),
}
ERROR_WIDTHS = {ORIGINAL: 2.0, IDENTIFIED: 0.9}
# Without script, and of the figures of speed and frequency in print; with script every joint can be
# chosen.
JOINTS_SHOWN, JOINTS_PRINTED = 6, 3
POINTS = 500
# Lines break where rows are missing for this time, s, and this many times their usual distance.
PAUSE, USUAL = 0.25, 3.0
FEWEST_POINTS = 4
SPEED_BINS = 15
FEWEST_IN_BIN = 8
_TALL, _FLAT = (3.75, 2.9), (3.75, 2.05)


def drawn_forces(log: ReportData | None) -> ForceSeries | None:
    """Return the forces of a log, unless they are too few for a curve."""
    if log is None or log.forces is None or len(log.forces.time) < FEWEST_POINTS:
        return None
    return log.forces


def shown_joints(forces: ForceSeries, most: int = JOINTS_SHOWN) -> IntArray:
    """Return the joints with the largest errors, in the model's order; the base without joints.

    Errors of the identified model are compared as shares of the measured force, as in the overview.
    """
    joints = [
        place
        for place, name in enumerate(forces.coordinates)
        if not name.startswith("base/") and bool(forces.has_rows[place])
    ]
    places = np.array(joints or np.flatnonzero(forces.has_rows).tolist(), dtype=np.int64)
    measured, error = forces.rms_measured[places], np.nan_to_num(forces.rmse_after[places])
    share = np.divide(error, measured, out=np.zeros(len(places)), where=measured > 0)
    return np.sort(places[np.argsort(-share, kind="stable")[:most]])


def force_panels(forces: ForceSeries) -> tuple[Panel, ...]:
    """Draw force and, on an axis of its own, error of the joints with the largest errors."""

    def draw(figure: Figure, place: int) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for label, values in (
            (MEASURED, forces.measured),
            (ORIGINAL, forces.before),
            (IDENTIFIED, forces.after),
        ):
            _line(upper, forces.time, values[:, place], label)
        unit = forces.units[place]
        upper.set_ylabel(f"{_kind(unit)} [{unit}]")
        low, high = force_range(forces, place)
        if high > low:
            upper.set_ylim(low, high)
        _draw_errors(lower, forces, place)
        figure.align_ylabels([upper, lower])

    return _panels(forces, shown_joints(forces), "force", _TALL, draw)


def base_panels(forces: ForceSeries) -> tuple[Panel, ...]:
    """Draw the error of each component of the wrench on a floating base."""
    places = np.array(
        [
            place
            for place, name in enumerate(forces.coordinates)
            if name.startswith("base/") and forces.has_rows[place]
        ],
        dtype=np.int64,
    )
    return _panels(
        forces,
        places,
        "base",
        _FLAT,
        lambda figure, place: _draw_errors(figure.add_subplot(), forces, place),
    )


def speed_panels(forces: ForceSeries) -> tuple[Panel, ...]:
    """Draw the errors of the same joints against their speed."""

    def draw(figure: Figure, place: int) -> None:
        axes = figure.add_subplot()
        speed = forces.speed[:, place]
        for label, errors in (
            (ORIGINAL, forces.speed_before[:, place]),
            (IDENTIFIED, forces.speed_after[:, place]),
        ):
            style = STYLES[label]
            kept = slice(None, None, max(1, len(speed) // 300))
            axes.plot(
                speed[kept],
                errors[kept],
                linestyle="none",
                marker=".",
                markersize=2.2,
                markeredgewidth=0,
                alpha=0.45,
                color=style.colour,
            )
            axes.plot(*binned_medians(speed, errors), color=style.colour, linewidth=1.6)
        unit = forces.units[place]
        axes.set_ylabel(f"error [{unit}]")
        axes.set_xlabel(f"speed [{'rad/s' if unit == 'Nm' else 'm/s'}]")
        _limit(
            axes,
            shown_error(forces, place),
            forces.speed_before[:, place],
            forces.speed_after[:, place],
        )

    places = [
        place
        for place in shown_joints(forces).tolist()
        if np.isfinite(forces.speed[:, place]).any()
    ]
    return _panels(forces, places, "speed", _FLAT, draw)


def spectrum_panels(forces: ForceSeries) -> tuple[Panel, ...]:
    """Draw the amplitude spectra of the measured force and of both errors."""
    if not len(forces.frequency):
        return ()

    def draw(figure: Figure, place: int) -> None:
        axes = figure.add_subplot()
        for label, power in (
            (MEASURED, forces.power_measured),
            (ORIGINAL, forces.power_before),
            (IDENTIFIED, forces.power_after),
        ):
            style = STYLES[label]
            amplitude = np.sqrt(power[:, place])
            if np.any(amplitude > 0):
                axes.plot(
                    forces.frequency,
                    np.where(amplitude > 0, amplitude, np.nan),
                    color=style.colour,
                    linewidth=style.width,
                )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylabel(f"density [{forces.units[place]}/√Hz]")
        axes.set_xlabel("frequency [Hz]")
        axes.margins(x=0)

    return _panels(forces, shown_joints(forces), "spectrum", _FLAT, draw)


def binned_medians(speed: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return speeds (B,) and medians (B,) of the error in bins with equally many rows.

    Bins end at zero, where friction changes its sign.
    """
    used = np.isfinite(speed) & np.isfinite(error)
    speed, error = speed[used], error[used]
    parts: list[tuple[float, float]] = []
    for side in (speed < 0, speed >= 0):
        order = np.argsort(speed[side])
        count = min(SPEED_BINS, len(order) // FEWEST_IN_BIN)
        parts += [
            (float(np.median(speed[side][part])), float(np.median(error[side][part])))
            for part in (np.array_split(order, count) if count else ())
        ]
    if not parts:
        return np.zeros(0), np.zeros(0)
    middle, median = np.array(parts).T
    return middle, median


def _panels(
    forces: ForceSeries,
    places: Sequence[int] | IntArray,
    name: str,
    size: tuple[float, float],
    draw: Callable[[Figure, int], None],
) -> tuple[Panel, ...]:
    panels, printed = [], shown_joints(forces, JOINTS_PRINTED).tolist()
    for place in map(int, places):
        title, unit = forces.coordinates[place], forces.units[place]
        before, after = forces.rmse_before[place], forces.rmse_after[place]
        note = f"RMS error {significant(before)} → {significant(after)} {unit}"
        with figure_style():
            figure = Figure(figsize=size, layout="constrained")
            draw(figure, place)
            svg = inline_svg(figure, f"{name}-{place}", f"{title}. {note}")
        panels.append(Panel(title, svg, note, place in printed))
    return tuple(panels)


def _draw_errors(axes: Axes, forces: ForceSeries, place: int) -> None:
    """Draw the errors of both models over time."""
    errors = forces.measured[:, [place]] - np.stack(
        [forces.before[:, place], forces.after[:, place]], axis=1
    )
    for index, (label, width) in enumerate(ERROR_WIDTHS.items()):
        _line(axes, forces.time, errors[:, index], label, width)
    axes.set_ylabel(f"error [{forces.units[place]}]")
    axes.set_xlabel("time [s]")
    _limit(axes, shown_error(forces, place), errors[:, 0], errors[:, 1])


def force_range(forces: ForceSeries, place: int) -> tuple[float, float]:
    """Return the range of forces shown: measured and identified, and the original if near.

    That of a wrench on the base always contains the original model.
    """
    near = np.stack([forces.measured[:, place], forces.after[:, place]])
    near = near[np.isfinite(near)]
    far = forces.before[:, place]
    far = far[np.isfinite(far)]
    if not len(near) or not len(far):
        return 0.0, 0.0
    least, most = np.quantile(near, [0.002, 0.998]).tolist()
    span = most - least
    low, high = least, most
    if _is_of_base(forces, place):
        span = np.inf
    if least - span <= float(np.median(far)) <= most + span:
        low = max(min(least, float(far.min())), least - span)
        high = min(max(most, float(far.max())), most + span)
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def shown_error(forces: ForceSeries, place: int) -> float:
    """Return the size of errors up to which an axis reaches.

    Errors of a joint beyond the range of its measured force would hide all others. On the base,
    where a constant error of the original model is usual, nothing is cut off.
    """
    measured = forces.measured[:, place]
    measured = measured[np.isfinite(measured)]
    before, after = (
        error_limit(forces.measured[:, place] - one[:, place])
        for one in (forces.before, forces.after)
    )
    if _is_of_base(forces, place):
        return max(after, before)
    return max(after, min(before, float(np.ptp(measured)) if len(measured) else 0.0))


def _is_of_base(forces: ForceSeries, place: int) -> bool:
    return forces.coordinates[place].startswith("base/")


def has_hidden_errors(forces: ForceSeries) -> bool:
    """Return whether errors of the original model exceed an axis."""
    return any(
        error_limit(forces.measured[:, place] - forces.before[:, place])
        > 1.01 * shown_error(forces, place)
        for place in np.flatnonzero(forces.has_rows).tolist()
    )


def pauses(time: FloatArray) -> IntArray:
    """Return the places (G,) in a series before which rows are missing."""
    steps = np.diff(time)
    if not len(steps):
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(steps > max(PAUSE, USUAL * float(np.median(steps)))) + 1


def has_block_gaps(forces: ForceSeries, coverage: Coverage) -> bool:
    """Return whether rows are missing at a time at which every sensor has data."""
    time = forces.time
    return any(
        bool(
            np.any((coverage.used[:, 0] <= time[place - 1]) & (time[place] <= coverage.used[:, 1]))
        )
        for place in pauses(time).tolist()
    )


def broken(values: FloatArray, places: IntArray) -> FloatArray:
    """Return a series (N,) with NaN in each of G places, which breaks its line."""
    return np.insert(values, places, np.nan)


def _line(
    axes: Axes, time: FloatArray, values: FloatArray, label: str, width: float | None = None
) -> None:
    style = STYLES[label]
    for part in np.split(np.arange(len(time)), pauses(time)):
        used = part[np.isfinite(values[part])]
        if len(used):
            points = max(2, POINTS * len(part) // len(time))
            axes.plot(
                *downsample(time[used], values[used], points),
                color=style.colour,
                linewidth=width or style.width,
            )
    axes.margins(x=0)
    axes.yaxis.set_major_locator(MaxNLocator(4))


def _limit(axes: Axes, limit: float, *errors: FloatArray) -> None:
    """Fit the axis to the errors up to a limit."""
    found = np.concatenate([one[np.isfinite(one)] for one in errors])
    if limit > 0:
        low, high = max(float(found.min()), -limit), min(float(found.max()), limit)
        # Zero is always visible.
        low, high = min(low, 0.0), max(high, 0.0)
        axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))


def error_limit(errors: FloatArray) -> float:
    """Return the size up to which errors are shown."""
    found = np.abs(errors[np.isfinite(errors)])
    if not len(found):
        return 0.0
    return 1.1 * min(float(found.max()), 3 * float(np.quantile(found, 0.95)))


def _kind(unit: str) -> str:
    return "torque" if unit == "Nm" else "force"
