"""Report on one estimate, or a comparison of several, as a self-contained HTML page."""

from dataclasses import dataclass
from pathlib import Path

import jinja2

from symbid_ros.atomic_write import write_text
from symbid_ros.report.content import (
    METRICS,
    PRIOR,
    REALISTIC_METRICS,
    ReportContent,
    best_labels,
)
from symbid_ros.report.data_summary import parameter_groups, summarise_data
from symbid_ros.report.figures import (
    Panel,
    com_panels,
    link_error_panel,
    momentum_panels,
    torque_panels,
)
from symbid_ros.report.formatting import significant
from symbid_ros.report.plotting import Style, styles


@dataclass(frozen=True)
class FigureSection:
    """Panels with a common legend.

    Attributes
    ----------
    anchor, title, caption : str
        Id of the section, heading, and description.
    panels : tuple of Panel
        Side by side on wide screens, stacked on phones.
    legend : dict of str to Style
        Empty if the panel has a legend of its own.
    """

    anchor: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: dict[str, Style]


def write_report(content: ReportContent, path: Path) -> None:
    """Write the page to ``path`` and replace an older page atomically."""
    write_text(path, render(content))


def render(content: ReportContent) -> str:
    """Return the page as HTML without scripts and external resources."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symbid_ros", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["significant"] = significant
    errors = {method.label: method.metrics or {} for method in content.methods}
    return environment.get_template("report.html").render(
        content=content,
        css=(Path(__file__).with_name("report.css")).read_text(encoding="utf-8"),
        headline=headline(content),
        summary=summarise_data(content.estimate, content.intervals),
        metrics=METRICS if any(errors.values()) else (),
        errors=errors,
        best=best_labels(errors, METRICS),
        realistic=REALISTIC_METRICS if content.realistic else (),
        best_realistic=best_labels(content.realistic, REALISTIC_METRICS),
        figures=_figures(content),
        impossible={
            method.label: impossible_links(method.estimate.consistent)
            for method in content.methods
            if method.estimate is not None
        },
        estimates={m.label: m.estimate for m in content.methods if m.estimate is not None},
        groups=parameter_groups(content.estimate),
    )


def _figures(content: ReportContent) -> tuple[FigureSection, ...]:
    line_styles = styles(content)
    sections = []
    if content.predictions:
        predictions = content.predictions
        legend = {series.label: line_styles[series.label] for series in predictions}
        sections = [
            FigureSection(
                "com",
                "Centre of mass",
                "Predicted along the validation motion, in the base frame.",
                com_panels(predictions, line_styles),
                legend,
            ),
            FigureSection(
                "torque",
                "Joint torque",
                "Predicted from the true motion and contact wrenches of the validation log, for "
                "the most loaded joints.",
                torque_panels(predictions, content.joint_names, line_styles),
                legend,
            ),
            FigureSection(
                "momentum",
                "CoM momentum",
                "Linear momentum, and angular momentum about the centre of mass, in world axes.",
                momentum_panels(predictions, line_styles),
                legend,
            ),
        ]
    if content.link_errors is not None:
        sections.append(
            FigureSection(
                "links",
                "Error per link",
                "Mean relative error of each link's inertial parameters.",
                (link_error_panel(content.link_errors, line_styles),),
                {},
            )
        )
    return tuple(sections)


def impossible_links(consistent: dict[str, bool]) -> tuple[str, ...]:
    """Return the links that are physically impossible."""
    return tuple(link for link, possible in consistent.items() if not possible)


def headline(content: ReportContent) -> str:
    """Return a one-line summary of the chosen method's numbers."""
    estimate = content.estimate
    clauses = []
    metrics, prior = content.metrics_of(content.chosen), content.metrics_of(PRIOR)
    key = "com_position_rmse_mm"
    if metrics is not None and key in metrics:
        error = metrics[key]
        clause = f"CoM error {significant(error)} mm"
        if prior is not None and key in prior:
            relation = "better than" if error < prior[key] else "no better than"
            clause += f", {relation} the prior’s {significant(prior[key])} mm"
        clauses.append(clause)
    if estimate.determined is not None:
        clauses.append(
            f"{int(estimate.determined.sum())} of {len(estimate.names)} parameters "
            "determined by the data"
        )
    possible = len(estimate.consistent) - len(impossible_links(estimate.consistent))
    clauses.append(f"{possible} of {len(estimate.consistent)} links physically possible")
    return f"{content.chosen}: {'; '.join(clauses)}."
