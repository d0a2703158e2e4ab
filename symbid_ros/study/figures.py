"""Figures of errors, joint accelerations and the closed loop (thesis, Fig. 6 and 4.3)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.report.content import METRICS, LinkErrors
from symbid_ros.report.figures import POINTS, link_error_figure, link_means
from symbid_ros.report.formatting import significant
from symbid_ros.report.plotting import (
    INK,
    Style,
    downsample,
    figure_style,
    fix_layout,
    scale_errors,
)
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study.checks import AccelerationCheck
from symbid_ros.study.plotting import (
    WIDTH,
    CaptionedFigure,
    add_legend,
    label_styles,
    line_options,
    marker_options,
    stacked_panels,
)
from symbid_ros.study.scores import METRICS as KEYS
from symbid_ros.study.scores import REFERENCE, Case, Scores
from symbid_ros.study.table import file_stem
from symbid_ros.study.thesis import ACCELERATION_ERRORS, DATA, TITLES

# Errors that span more than these ratios are drawn on a logarithmic axis.
TRACKING_LOGARITHMIC_ABOVE = 20.0
SCORES_LOGARITHMIC_ABOVE = 8.0
_JOINT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07c00", "#56b4e9", "#000000")
_JOINT_DASHES = ("-", "--", ":", "-.")
# Position left of the cutoffs, for methods without a filter.
_NO_FILTER = -1
_THESIS = Style(INK, "", 0.0, "o")


def link_figure(errors: LinkErrors, estimates: str, draws: int) -> CaptionedFigure:
    """Plot the mean parameter error of each link over ``draws`` priors (thesis, Fig. 6).

    Links are listed from top to bottom, so that their names are upright.
    """
    labels = list(errors.percent)
    names = [f"{number}  {link}" for number, link in enumerate(errors.links, 1)]
    with figure_style():
        figure = link_error_figure(errors, names, label_styles(labels), WIDTH)
        fix_layout(figure)
    title = "Fig. 6: mean parameter error of each link"
    return CaptionedFigure(
        "fig_6_links",
        title,
        f"Mean over {draws} draws. {estimates} Mean over the links: {link_means(errors)}.",
        figure,
        f"{title}, in %, of {len(errors.links)} links from {errors.links[0]} to "
        f"{errors.links[-1]}, a dot for each of {', '.join(labels)}.",
    )


def acceleration_figure(logs: Mapping[str, AccelerationCheck], cutoff: float) -> CaptionedFigure:
    """Plot true joint accelerations, by log, and state their errors if filtered (Fig. 4.3)."""
    joint_names = next(iter(logs.values())).joint_names
    lines = [
        {
            "color": _JOINT_COLOURS[j % len(_JOINT_COLOURS)],
            "linestyle": _JOINT_DASHES[j // len(_JOINT_COLOURS) % len(_JOINT_DASHES)],
            "linewidth": 0.7,
        }
        for j in range(len(joint_names))
    ]
    headings = {name: f"({chr(ord('a') + i)}) {name}" for i, name in enumerate(logs)}
    legend_rows = -(-len(joint_names) // 4)
    height = 0.5 + 0.2 * legend_rows
    with stacked_panels(len(logs), 1.9, other_height=height, share_x=False) as (figure, panels):
        for axes, (name, log) in zip(panels, logs.items(), strict=True):
            strength = np.sqrt(np.mean(log.acceleration**2, axis=0))
            # The strongest are drawn first, so that they do not cover the others.
            for j in np.argsort(-strength, kind="stable"):
                axes.plot(*downsample(log.time, log.acceleration[:, j], POINTS), **lines[j])
            title = f"{headings[name]}: acceleration [rad/s²]"
            axes.set_title(title, loc="left", fontsize="medium")
            axes.set_xlim(log.time[0], log.time[-1])
        panels[-1].set_xlabel("time [s]")
        thick = [{**line, "linewidth": 1.6} for line in lines]
        add_legend(figure, dict(zip(joint_names, thick, strict=True)))
    title = "Fig. 4.3: ideal joint accelerations"
    errors = "; ".join(_describe_acceleration(headings[name], name, logs[name]) for name in logs)
    return CaptionedFigure(
        "fig_4_3_accelerations",
        title,
        "Root mean square (RMS) of the vector of all joint accelerations, and of its error e_a "
        f"after a filter of {cutoff:g} Hz (Eq. 4.2): {errors}.",
        figure,
        f"{title} over time in rad/s², a curve for each of {len(joint_names)} joints, of the logs "
        f"{', '.join(headings.values())}.",
    )


def _describe_acceleration(heading: str, name: str, log: AccelerationCheck) -> str:
    printed = ACCELERATION_ERRORS.get(name)
    thesis = "" if printed is None else f" (thesis: {significant(printed, 2)} rad/s²)"
    rms, error = significant(log.rms), significant(log.error)
    return f"{heading}, RMS {rms} rad/s², e_a {error} rad/s²{thesis}"


def closed_loop_figure(runs: Mapping[str, Sequence[BalanceResult]], about: str) -> CaptionedFigure:
    """Plot how well the balance controller performs with each model.

    Parameters
    ----------
    runs : mapping of str to sequence of BalanceResult
        By label of the model.
    about : str
        Start of the caption: priors, data and moves.

    Raises
    ------
    StudyError
        If a label has no runs.
    """
    for label, own in runs.items():
        if not own:
            raise StudyError(f"closed loop of {label}: no runs; leave it out of the figure", "E709")
    styles = label_styles(runs)
    errors = {k: np.array([run.com_rmse_mm for run in own]) for k, own in runs.items()}
    shares = {k: np.array([100 * run.feed_forward_share for run in own]) for k, own in runs.items()}
    height = 0.26 * len(runs) + 0.65
    with stacked_panels(2, height, other_height=0.3, share_x=False) as (figure, panels):
        tracking, feed_forward = panels
        tracking.set_xlabel("CoM tracking RMSE [mm]")
        _plot_runs(tracking, errors, styles)
        scale_errors(tracking, "x", np.concatenate([*errors.values()]), TRACKING_LOGARITHMIC_ABOVE)
        for row, own in enumerate(runs.values()):
            _mark_failures(tracking, row, sum(bool(run.failure) for run in own), len(own))
        feed_forward.set_xlabel("feed-forward share of the torque [%]")
        _plot_runs(feed_forward, shares, styles)
        add_legend(
            figure,
            {
                "a run": {"marker": "o", "linestyle": "none", **_faint(INK)},
                "mean": {"marker": "|", "linestyle": "none", **_bar(INK)},
                "failed": {"marker": "x", "linestyle": "none", "color": INK},
            },
        )
    title = "Closed loop: balance with an estimated model"
    return CaptionedFigure(
        "closed_loop",
        title,
        f"{about} {_describe_runs(runs)}",
        figure,
        f"{title}: tracking error of the centre of mass and feed-forward share of the torque for "
        f"{', '.join(runs)}; a dot for each run, a bar at the mean.",
    )


def _plot_runs(axes: Axes, values: Mapping[str, FloatArray], styles: Mapping[str, Style]) -> None:
    """Plot a row for each label: a dot for each completed run, a bar at their mean."""
    for row, (label, own) in enumerate(values.items()):
        completed = own[np.isfinite(own)]
        colour = styles[label].colour
        # Spread over the row, so that equal runs stay visible.
        spread = 0.18 * np.linspace(-1.0, 1.0, len(completed)) if len(completed) > 1 else 0.0
        axes.plot(completed, row + spread + 0 * completed, "o", **_faint(colour))
        if len(completed):
            axes.plot([completed.mean()], [row], "|", **_bar(colour))
    axes.set_yticks(range(len(values)), list(values))
    axes.set_ylim(len(values) - 0.5, -0.5)


def _mark_failures(axes: Axes, row: int, failed: int, count: int) -> None:
    """Annotate the right end of a row with the number of failed runs."""
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


def _describe_runs(runs: Mapping[str, Sequence[BalanceResult]]) -> str:
    """Return the mean of each label, and the number and causes of its failures."""
    sentences = []
    for label, own in runs.items():
        completed = [run.com_rmse_mm for run in own if not run.failure]
        mean = f"{significant(float(np.mean(completed)))} mm" if completed else "all failed"
        failures = Counter(run.failure for run in own if run.failure)
        causes = ", ".join(f"{cause} in {times} of {len(own)}" for cause, times in failures.items())
        sentences.append(f"{label} {mean}{f' ({causes})' if causes else ''}")
    return f"Mean tracking RMSE of the completed runs: {'; '.join(sentences)}."


def comparison_figure(
    scores: Scores,
    data: Sequence[str],
    prior: str,
    methods: Sequence[str],
    cutoff: float | None = None,
    *,
    shown: Sequence[str] = KEYS,
) -> CaptionedFigure:
    """Plot each metric of each method and data set.

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
        Cutoff of the truncated methods' rows, Hz; default: the best for each metric.
    shown : sequence of str
        Keys of the metrics to plot.

    Raises
    ------
    StudyError
        If there is nothing to plot.
    """
    found = {
        (name, method): _means(scores, name, prior, method, cutoff)
        for name in data
        for method in methods
    }
    drawn = [method for method in methods if any(found[name, method] for name in data)]
    if not drawn:
        raise _no_scores(prior, data)
    styles = label_styles(TITLES[method] for method in drawn)
    shift = np.linspace(-0.3, 0.3, len(drawn)) if len(drawn) > 1 else np.zeros(1)
    height = 0.6 + max(0.3, 0.05 * len(drawn)) * len(data)
    rows = np.arange(len(data))
    metrics = [metric for metric in METRICS if metric.key in shown]
    with stacked_panels(len(metrics), height, other_height=0.5, share_x=False) as (figure, panels):
        for axes, metric in zip(panels, metrics, strict=True):
            values = np.array([[found[n, m].get(metric.key, np.nan) for n in data] for m in drawn])
            for style, own, offset in zip(styles.values(), values, shift, strict=True):
                axes.plot(own, rows + offset, linestyle="none", **marker_options(style))
            scale_errors(axes, "x", values.ravel(), SCORES_LOGARITHMIC_ABOVE)
            axes.set_yticks(rows, list(data))
            axes.set_ylim(len(data) - 0.5, -0.5)
            axes.set_title(f"{metric.title} [{metric.unit}]", loc="left", fontsize="medium")
        add_legend(
            figure,
            {label: {**marker_options(s), "linestyle": "none"} for label, s in styles.items()},
        )
    rows_of = "with the best filter" if cutoff is None else f"with rows filtered at {cutoff:g} Hz"
    title = f"Errors, priors within {prior}"
    return CaptionedFigure(
        f"comparison_{file_stem(prior)}",
        title,
        f"Mean of each metric over the draws, truncated methods {rows_of}; smaller is better. "
        f"{TITLES[REFERENCE]}: the prior.",
        figure,
        f"{title}: a panel for each metric, a row for each of the data sets {', '.join(data)}, a "
        f"marker for each of {', '.join(styles)}.",
    )


def _no_scores(prior: str, data: Sequence[str]) -> StudyError:
    return StudyError(
        f"no scores of {prior} for {', '.join(data)}; choose a prior and data of the study", "E709"
    )


def _means(
    scores: Scores, data: str, prior: str, method: str, cutoff: float | None
) -> Mapping[str, float]:
    if cutoff is None:
        return scores.best(data, prior, method)
    return scores.means.get(Case.of(data, prior, method, cutoff), {})


def filter_figure(
    scores: Scores,
    data: str,
    prior: str,
    methods: Sequence[str],
    thesis: Scores | None = None,
    *,
    shown: Sequence[str] = KEYS,
) -> CaptionedFigure:
    """Plot each metric against the filter's cutoff (thesis, Table C.1).

    Parameters
    ----------
    scores : Scores
    data, prior : str
        Name of the data set, and how the priors were drawn.
    methods : sequence of str
        "ref" and names of methods, in the order of the legend.
    thesis : Scores, optional
        The thesis's values from `symbid_ros.study.thesis`, shown as hollow markers.
    shown : sequence of str
        Keys of the metrics to plot.

    Raises
    ------
    StudyError
        If there is nothing to plot.
    """
    drawn = [method for method in methods if scores.filters(data, prior, method)]
    if not drawn:
        raise _no_scores(prior, [data])
    tried = {c for m in drawn for c in scores.filters(data, prior, m) if c is not None}
    # Unfiltered rows come last, as if their cutoff were infinite.
    cutoffs = [*sorted(tried - {0.0}), *sorted(tried & {0.0})]
    compared = False
    styles = label_styles(TITLES[method] for method in drawn)
    metrics = [metric for metric in METRICS if metric.key in shown]
    with stacked_panels(len(metrics), 1.7, other_height=0.75) as (figure, panels):
        for axes, metric in zip(panels, metrics, strict=True):
            plotted: list[float] = []
            for method in drawn:
                style = styles[TITLES[method]]
                case = Case(data, prior, method)
                places, values = _points(scores, case, cutoffs, metric.key)
                if places == [_NO_FILTER]:
                    axes.axhline(values[0], **line_options(style))
                axes.plot(places, values, **line_options(style) | marker_options(style))
                plotted += values
                if thesis is None:
                    continue
                places, values = _points(thesis, replace(case, data=DATA), cutoffs, metric.key)
                hollow = marker_options(style, hollow=True)
                axes.plot(places, values, linestyle="none", **hollow)
                compared |= bool(values)
                plotted += values
            scale_errors(axes, "y", np.array(plotted), SCORES_LOGARITHMIC_ABOVE)
            axes.set_title(f"{metric.title} [{metric.unit}]", loc="left", fontsize="medium")
        names = [f"{cutoff:g}" if cutoff else "none" for cutoff in cutoffs]
        panels[-1].set_xticks([_NO_FILTER, *range(len(cutoffs))], ["any", *names])
        panels[-1].set_xlim(_NO_FILTER - 0.25, len(cutoffs) - 0.75)
        panels[-1].set_xlabel("cutoff of the filter [Hz]")
        entries = {label: line_options(s) | marker_options(s) for label, s in styles.items()}
        if compared:
            entries["thesis"] = {"linestyle": "none", **marker_options(_THESIS, hollow=True)}
        add_legend(figure, entries)
    title = f"Errors against the filter, data set {data}, priors within {prior}"
    return CaptionedFigure(
        f"grid_{file_stem(data)}_{file_stem(prior)}",
        title,
        "Mean of each metric over the draws against the cutoff of the rows' filter; smaller is "
        "better. Horizontal lines: the prior, and methods that average rows over windows."
        + (" Hollow markers: the thesis's values (Table C.1)." if compared else ""),
        figure,
        f"{title}: a panel for each metric, a curve for each of {', '.join(styles)}"
        f"{', the thesis’s values as hollow markers' if compared else ''}.",
    )


def _points(
    scores: Scores, case: Case, cutoffs: Sequence[float], key: str
) -> tuple[list[int], list[float]]:
    """Return positions along the axis and one metric's values there, for any filter."""
    places, values = [], []
    for place, cutoff in enumerate([None, *cutoffs], _NO_FILTER):
        means = scores.at(case.data, case.prior, case.method, cutoff)
        if key in means:
            places.append(place)
            values.append(means[key])
    return places, values
