"""The five metrics drawn: over data sets, and over the filter's cutoff (thesis, Table C.1)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes

from symbid_ros.errors import StudyError
from symbid_ros.report.content import METRICS
from symbid_ros.report.plotting import INK, Style, scale_errors
from symbid_ros.study.drawing import LABELS, Drawing, curve, legend, looks, marks, stack
from symbid_ros.study.scores import METRICS as KEYS
from symbid_ros.study.scores import Case, Scores
from symbid_ros.study.thesis import DATA

# Errors that span more than this ratio are drawn on a logarithmic axis.
LOGARITHMIC_ABOVE = 8.0
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
        raise StudyError(f"no scores of {prior} for {', '.join(data)}; draw what the study has")
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
            scale_errors(axes, "x", values.ravel(), LOGARITHMIC_ABOVE)
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
        raise StudyError(f"no scores of {prior} for {data}; draw what the study has")
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
            scale_errors(axes, "y", np.array(drawn_values), LOGARITHMIC_ABOVE)
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
