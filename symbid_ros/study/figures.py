"""Errors per link, joint accelerations, and the closed loop (thesis, Fig. 6 and 4.3)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.report.content import METRICS, LinkErrors
from symbid_ros.report.figures import POINTS, link_error_figure, link_means
from symbid_ros.report.formatting import significant
from symbid_ros.report.plotting import INK, Style, downsample, house_style, scale_errors
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study.plotting import (
    LABELS,
    WIDTH,
    Drawing,
    curve,
    legend,
    looks,
    marks,
    settle,
    stack,
)
from symbid_ros.study.prediction_figures import Setting
from symbid_ros.study.scores import METRICS as KEYS
from symbid_ros.study.scores import Case, Scores
from symbid_ros.study.thesis import DATA

# Tracking errors that span more than this ratio are drawn on a logarithmic axis.
LOGARITHMIC_ABOVE = 20.0
_JOINT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07c00", "#56b4e9", "#000000")
_JOINT_DASHES = ("-", "--", ":", "-.")


@dataclass(frozen=True)
class AccelerationLog:
    """One log's joint accelerations (thesis, Fig. 4.3).

    Attributes
    ----------
    title : str
        Such as "with vibrating legs".
    time : (N,) float64
        Seconds.
    acceleration : (N, J) float64
        True ones, rad/s².
    error : float
        RMSE of the filtered accelerations, e_a of Eq. 4.2, rad/s².
    thesis_error : float or None
        The thesis's, where it has one.
    """

    title: str
    time: FloatArray
    acceleration: FloatArray
    error: float
    thesis_error: float | None = None


def link_drawing(errors: LinkErrors, setting: Setting, draws: int) -> Drawing:
    """Draw every link's mean parameter error over ``draws`` priors (thesis, Fig. 6).

    Links go down the figure rather than along it, so that their names can be read upright.
    """
    labels = list(errors.percent)
    names = [f"{number}  {link}" for number, link in enumerate(errors.links, 1)]
    with house_style():
        figure = link_error_figure(errors, names, looks(labels), WIDTH)
        settle(figure)
    title = "Fig. 6: mean parameter error of each link"
    return Drawing(
        "fig_6_links",
        title,
        f"Mean over {draws} draws. {setting} Mean over the links: {link_means(errors)}.",
        figure,
        f"{title}, in %, of {len(errors.links)} links from {errors.links[0]} to "
        f"{errors.links[-1]}, a dot each for {', '.join(labels)}.",
    )


def acceleration_drawing(
    logs: Sequence[AccelerationLog], joint_names: Sequence[str], cutoff: float
) -> Drawing:
    """Draw the true joint accelerations of logs, and say what a filter makes of them (Fig. 4.3).

    Parameters
    ----------
    logs : sequence of AccelerationLog
    joint_names : sequence of str
        Of their J columns.
    cutoff : float
        Hz, of the filter whose errors they state.
    """
    rows = -(-len(joint_names) // 4)
    lines = [
        {
            "color": _JOINT_COLOURS[j % len(_JOINT_COLOURS)],
            "linestyle": _JOINT_DASHES[j // len(_JOINT_COLOURS) % len(_JOINT_DASHES)],
            "linewidth": 0.7,
        }
        for j in range(len(joint_names))
    ]
    headings = [f"({chr(ord('a') + i)}) {log.title}" for i, log in enumerate(logs)]
    other = 0.5 + 0.2 * rows
    with stack(len(logs), 1.9, other_height=other, share_x=False) as (figure, panels):
        for axes, log, heading in zip(panels, logs, headings, strict=True):
            strength = np.sqrt(np.mean(log.acceleration**2, axis=0))
            # The strongest lie below, lest they hide the others.
            for j in np.argsort(-strength, kind="stable"):
                axes.plot(*downsample(log.time, log.acceleration[:, j], POINTS), **lines[j])
            axes.set_title(f"{heading}: acceleration [rad/s²]", loc="left", fontsize="medium")
            axes.set_xlim(log.time[0], log.time[-1])
        panels[-1].set_xlabel("time [s]")
        thick = [{**line, "linewidth": 1.6} for line in lines]
        legend(figure, dict(zip(joint_names, thick, strict=True)))
    told = "; ".join(_told(log, heading) for log, heading in zip(logs, headings, strict=True))
    title = "Fig. 4.3: ideal joint accelerations"
    return Drawing(
        "fig_4_3_accelerations",
        title,
        f"Root mean square (RMS) of the vector of all joints, and of its error e_a once filtered "
        f"at {cutoff:g} Hz (Eq. 4.2): {told}.",
        figure,
        f"{title} over time in rad/s², a curve for each of {len(joint_names)} joints, of the logs "
        f"{', '.join(headings)}.",
    )


def _told(log: AccelerationLog, heading: str) -> str:
    rms = float(np.sqrt(np.mean(np.sum(log.acceleration**2, axis=1))))
    thesis = (
        "" if log.thesis_error is None else f" (thesis: {significant(log.thesis_error, 2)} rad/s²)"
    )
    return f"{heading}, RMS {significant(rms)} rad/s², e_a {significant(log.error)} rad/s²{thesis}"


def closed_loop_drawing(runs: Mapping[str, Sequence[BalanceResult]], about: str) -> Drawing:
    """Draw how well the balance controller works with the models it believes.

    Parameters
    ----------
    runs : mapping of str to sequence of BalanceResult
        By label of the parameter set.
    about : str
        Of which priors, data and moves, for the caption.

    Raises
    ------
    StudyError
        When a label has no runs.
    """
    for label, own in runs.items():
        if not own:
            raise StudyError(f"closed loop of {label}: no runs; leave it out of the figure", "E709")
    styles = looks(runs)
    errors = {k: np.array([run.com_rmse_mm for run in own]) for k, own in runs.items()}
    shares = {k: np.array([100 * run.feed_forward_share for run in own]) for k, own in runs.items()}
    height = 0.26 * len(runs) + 0.65
    with stack(2, height, other_height=0.3, share_x=False) as (figure, panels):
        tracking, feed_forward = panels
        tracking.set_xlabel("CoM tracking RMSE [mm]")
        _rows(tracking, errors, styles)
        scale_errors(tracking, "x", np.concatenate([*errors.values()]), LOGARITHMIC_ABOVE)
        for row, own in enumerate(runs.values()):
            _mark_failures(tracking, row, sum(bool(run.failure) for run in own), len(own))
        feed_forward.set_xlabel("feed-forward share of the torque [%]")
        _rows(feed_forward, shares, styles)
        legend(
            figure,
            {
                "a run": {"marker": "o", "linestyle": "none", **_faint(INK)},
                "mean": {"marker": "|", "linestyle": "none", **_bar(INK)},
                "failed": {"marker": "x", "linestyle": "none", "color": INK},
            },
        )
    title = "Closed loop: balance with the model believed"
    return Drawing(
        "closed_loop",
        title,
        f"{about} {_outcomes(runs)}",
        figure,
        f"{title}: tracking error of the centre of mass and feed-forward share of the torque for "
        f"{', '.join(runs)}; a dot for each run, a bar at the mean.",
    )


def _rows(axes: Axes, values: Mapping[str, FloatArray], styles: Mapping[str, Style]) -> None:
    """Draw a row for each label: a dot for each run that lasted, a bar at their mean."""
    for row, (label, own) in enumerate(values.items()):
        lasted = own[np.isfinite(own)]
        colour = styles[label].colour
        # Spread over the row, equal runs would be one otherwise.
        spread = 0.18 * np.linspace(-1.0, 1.0, len(lasted)) if len(lasted) > 1 else 0.0
        axes.plot(lasted, row + spread + 0 * lasted, "o", **_faint(colour))
        if len(lasted):
            axes.plot([lasted.mean()], [row], "|", **_bar(colour))
    axes.set_yticks(range(len(values)), list(values))
    axes.set_ylim(len(values) - 0.5, -0.5)


def _mark_failures(axes: Axes, row: int, failed: int, count: int) -> None:
    """Say beside the row, where no error can be, how many runs did not last."""
    if failed:
        axes.annotate(
            f"× {failed} of {count}",
            (1.02, row),
            xycoords=axes.get_yaxis_transform(),
            va="center",
            color=INK,
            annotation_clip=False,
        )


def _faint(colour: str) -> dict[str, Any]:
    return {"color": colour, "markersize": 4.0, "alpha": 0.55, "markeredgewidth": 0.0}


def _bar(colour: str) -> dict[str, Any]:
    return {"color": colour, "markersize": 11.0, "markeredgewidth": 1.8}


def _outcomes(runs: Mapping[str, Sequence[BalanceResult]]) -> str:
    """Say each one's mean, and of those that failed how often and why."""
    sentences = []
    for label, own in runs.items():
        lasted = [run.com_rmse_mm for run in own if not run.failure]
        mean = f"{significant(float(np.mean(lasted)))} mm" if lasted else "none lasted"
        failures = Counter(run.failure for run in own if run.failure)
        why = ", ".join(f"{cause} in {times} of {len(own)}" for cause, times in failures.items())
        sentences.append(f"{label} {mean}{f' ({why})' if why else ''}")
    return f"Mean tracking RMSE of the runs that lasted: {'; '.join(sentences)}."


# Errors that span more than this ratio are drawn on a logarithmic axis.
SCORES_LOGARITHMIC_ABOVE = 8.0
# Place, before the cutoffs, of what has no filter to choose.
_NO_FILTER = -1
_THESIS = Style(INK, "", 0.0, "o")


def comparison_drawing(
    scores: Scores,
    data: Sequence[str],
    prior: str,
    methods: Sequence[str],
    cutoff: float | None = None,
    *,
    shown: Sequence[str] = KEYS,
) -> Drawing:
    """Draw each metric of each method for each data set.

    Parameters
    ----------
    scores : Scores
    data : sequence of str
        Names of the data sets, in the order shown.
    prior : str
        How the priors were drawn.
    methods : sequence of str
        "ref" and names of methods, in the order of the legend.
    cutoff : float, optional
        Hz, of the truncated methods' rows; else each metric's best over the filters.
    shown : sequence of str
        Keys of the metrics that have panels.

    Raises
    ------
    StudyError
        When there is nothing to draw.
    """
    found = {
        (name, method): _means(scores, name, prior, method, cutoff)
        for name in data
        for method in methods
    }
    drawn = [method for method in methods if any(found[name, method] for name in data)]
    if not drawn:
        raise StudyError(
            f"no scores of {prior} for {', '.join(data)}; draw what the study has", "E709"
        )
    styles = looks(LABELS[method] for method in drawn)
    shift = np.linspace(-0.3, 0.3, len(drawn)) if len(drawn) > 1 else np.zeros(1)
    height = 0.6 + max(0.3, 0.05 * len(drawn)) * len(data)
    rows = np.arange(len(data))
    metrics = [metric for metric in METRICS if metric.key in shown]
    with stack(len(metrics), height, other_height=0.5, share_x=False) as (figure, panels):
        for axes, metric in zip(panels, metrics, strict=True):
            values = np.array([[found[n, m].get(metric.key, np.nan) for n in data] for m in drawn])
            for label, own, offset in zip(styles, values, shift, strict=True):
                axes.plot(own, rows + offset, linestyle="none", **marks(styles[label]))
            scale_errors(axes, "x", values.ravel(), SCORES_LOGARITHMIC_ABOVE)
            axes.set_yticks(rows, list(data))
            axes.set_ylim(len(data) - 0.5, -0.5)
            axes.set_title(f"{metric.title} [{metric.unit}]", loc="left", fontsize="medium")
        legend(figure, {label: {**marks(s), "linestyle": "none"} for label, s in styles.items()})
    how = "at the filter best for it" if cutoff is None else f"with rows filtered at {cutoff:g} Hz"
    title = f"Errors, priors within {prior}"
    return Drawing(
        f"comparison_{_stem(prior)}",
        title,
        f"Mean over the draws of each metric, truncated methods {how}; less is better.",
        figure,
        f"{title}: a panel for each metric, a row for each of the data sets {', '.join(data)}, a "
        f"marker for each of {', '.join(styles)}.",
    )


def _means(
    scores: Scores, data: str, prior: str, method: str, cutoff: float | None
) -> dict[str, float]:
    if cutoff is None:
        return scores.best(data, prior, method)
    # The prior, and methods with windows, have no filter.
    return dict(scores.at(data, prior, method, cutoff) or scores.at(data, prior, method, None))


def grid_drawing(
    scores: Scores,
    data: str,
    prior: str,
    methods: Sequence[str],
    thesis: Scores | None = None,
    *,
    shown: Sequence[str] = KEYS,
) -> Drawing:
    """Draw each metric against the filter's cutoff (thesis, Table C.1).

    Parameters
    ----------
    scores : Scores
    data, prior : str
        Name of the data set, and how the priors were drawn.
    methods : sequence of str
        "ref" and names of methods, in the order of the legend.
    thesis : Scores, optional
        The thesis's values, as `symbid_ros.study.thesis` gives them; hollow markers.
    shown : sequence of str
        Keys of the metrics that have panels.

    Raises
    ------
    StudyError
        When there is nothing to draw.
    """
    drawn = [method for method in methods if scores.filters(data, prior, method)]
    if not drawn:
        raise StudyError(f"no scores of {prior} for {data}; draw what the study has", "E709")
    tried = {c for m in drawn for c in scores.filters(data, prior, m) if c is not None}
    # Without a filter nothing is cut off: that lies beyond the highest cutoff.
    cutoffs = [*sorted(tried - {0.0}), *sorted(tried & {0.0})]
    compared = False
    styles = looks(LABELS[method] for method in drawn)
    metrics = [metric for metric in METRICS if metric.key in shown]
    with stack(len(metrics), 1.7, other_height=0.75) as (figure, panels):
        for axes, metric in zip(panels, metrics, strict=True):
            drawn_values: list[float] = []
            for method in drawn:
                style = styles[LABELS[method]]
                case = Case(data, prior, method)
                places, values = _points(scores, case, cutoffs, metric.key)
                if places == [_NO_FILTER]:
                    axes.axhline(values[0], **curve(style))
                axes.plot(places, values, **curve(style) | marks(style))
                drawn_values += values
                if thesis is None:
                    continue
                places, values = _points(thesis, replace(case, data=DATA), cutoffs, metric.key)
                axes.plot(places, values, linestyle="none", **marks(style, hollow=True))
                compared |= bool(values)
                drawn_values += values
            scale_errors(axes, "y", np.array(drawn_values), SCORES_LOGARITHMIC_ABOVE)
            axes.set_title(f"{metric.title} [{metric.unit}]", loc="left", fontsize="medium")
        _label_cutoffs(panels[-1], cutoffs)
        entries = {label: curve(s) | marks(s) for label, s in styles.items()}
        if compared:
            entries["thesis"] = {"linestyle": "none", **marks(_THESIS, hollow=True)}
        legend(figure, entries)
    title = f"Errors against the filter, data set {data}, priors within {prior}"
    return Drawing(
        f"grid_{_stem(data)}_{_stem(prior)}",
        title,
        "Mean over the draws of each metric against the cutoff of the rows' filter, less is "
        "better. Level lines: the prior, and methods whose rows are averaged over windows instead."
        + (" Hollow: the thesis's values (Table C.1)." if compared else ""),
        figure,
        f"{title}: a panel for each metric, a curve for each of {', '.join(styles)}"
        f"{', the thesis’s values as hollow markers' if compared else ''}.",
    )


def _points(
    scores: Scores, case: Case, cutoffs: Sequence[float], key: str
) -> tuple[list[int], list[float]]:
    """Return places along the axis and one metric's values there, whatever the case's filter."""
    places, values = [], []
    for place, cutoff in enumerate([None, *cutoffs], _NO_FILTER):
        means = scores.at(case.data, case.prior, case.method, cutoff)
        if key in means:
            places.append(place)
            values.append(means[key])
    return places, values


def _label_cutoffs(axes: Axes, cutoffs: Sequence[float]) -> None:
    names = [f"{cutoff:g}" if cutoff else "none" for cutoff in cutoffs]
    axes.set_xticks([_NO_FILTER, *range(len(cutoffs))], ["any", *names])
    axes.set_xlim(_NO_FILTER - 0.25, len(cutoffs) - 0.75)
    axes.set_xlabel("cutoff of the filter [Hz]")


def _stem(text: str) -> str:
    """Return what of a name can be in a file's and in an id."""
    words = text.replace("±", "").replace("%", "percent").split()
    return "_".join("".join(c if c.isalnum() or c in ".+-_" else "" for c in w) for w in words)
