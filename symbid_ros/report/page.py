"""Report on one estimate, or a comparison of several, as a self-contained HTML page."""

import re
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
from symbid_ros.report.data_summary import link_rows, parameter_groups, verdict_entries
from symbid_ros.report.figures import (
    TORQUES_SHOWN,
    Panel,
    com_signals,
    link_error_panel,
    momentum_signals,
    signal_panels,
    torque_signals,
)
from symbid_ros.report.formatting import significant, with_std
from symbid_ros.report.plotting import Style, styles

# In a direction of parameter space, such as "+0.72 base_link/m -0.37 link_0/mc_x".
_COEFFICIENT = re.compile(r"([+-])(\d\S*) ")


@dataclass(frozen=True)
class FigureSection:
    """Panels with a common legend, side by side on wide screens and stacked on phones."""

    anchor: str  # id of the section
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: dict[str, Style]  # empty if the panel has a legend of its own


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
    environment.filters |= {
        "significant": significant,
        "with_std": with_std,
        "unbroken": lambda direction: _COEFFICIENT.sub(_unbroken, direction),
    }
    errors = {method.label: method.metrics or {} for method in content.methods}
    return environment.get_template("report.html").render(
        content=content,
        css=(Path(__file__).with_name("report.css")).read_text(encoding="utf-8"),
        headline=headline(content),
        verdict=content.estimate.verdict,
        entries=verdict_entries(content.estimate),
        links=link_rows(content.estimate),
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


def _unbroken(coefficient: re.Match[str]) -> str:
    """Return a coefficient with a minus sign and a non-breaking space before its parameter."""
    sign = coefficient[1].replace("-", "−")
    return f"{sign}{coefficient[2]}\N{NO-BREAK SPACE}"


def _figures(content: ReportContent) -> tuple[FigureSection, ...]:
    line_styles = styles(content)
    sections = []
    if content.predictions:
        predictions = content.predictions
        torques = torque_signals(predictions, content.joint_names, TORQUES_SHOWN)
        legend = {series.label: line_styles[series.label] for series in predictions}
        sections = [
            FigureSection(
                "com",
                "Centre of mass",
                "Predicted along the validation motion, in the base frame.",
                signal_panels(com_signals(predictions), predictions, line_styles),
                legend,
            ),
            FigureSection(
                "torque",
                "Joint torque",
                "Predicted from the true motion and contact wrenches of the validation log, for "
                "the most loaded joints.",
                signal_panels(torques, predictions, line_styles),
                legend,
            ),
            FigureSection(
                "momentum",
                "CoM momentum",
                "Linear momentum, and angular momentum about the centre of mass, in world axes.",
                signal_panels(momentum_signals(predictions), predictions, line_styles),
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
