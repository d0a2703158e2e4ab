"""One estimate, or several compared, as one self-contained page of HTML."""

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
    """Panels that share a legend.

    Attributes
    ----------
    anchor, title, caption : str
        Fragment of the address, heading, and what is drawn in which frame.
    panels : tuple of Panel
        Side by side on a desk, one below the other on a phone.
    legend : dict of str to Style
        Empty where the panel has its own.
    """

    anchor: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: dict[str, Style]


def write_report(content: ReportContent, path: Path) -> None:
    """Write the page to ``path``; an older page stays whole until the new one is complete."""
    write_text(path, render(content))


def render(content: ReportContent) -> str:
    """Return the page: no script, no address outside itself."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symbid_ros", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["significant"] = significant
    measured = {method.label: method.metrics or {} for method in content.methods}
    return environment.get_template("report.html").render(
        content=content,
        css=(Path(__file__).with_name("report.css")).read_text(encoding="utf-8"),
        headline=headline(content),
        told=summarise_data(content.estimate, content.intervals),
        metrics=METRICS if any(measured.values()) else (),
        measured=measured,
        best=best_labels(measured, METRICS),
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
    look = styles(content)
    sections = []
    if content.predictions:
        predictions = content.predictions
        legend = {series.label: look[series.label] for series in predictions}
        sections = [
            FigureSection(
                "com",
                "Centre of mass",
                "Predicted along the validation motion, in the base frame.",
                com_panels(predictions, look),
                legend,
            ),
            FigureSection(
                "torque",
                "Joint torque",
                "Predicted along the validation motion with the true motion and contact wrenches; "
                "the joints that carry most.",
                torque_panels(predictions, content.joint_names, look),
                legend,
            ),
            FigureSection(
                "momentum",
                "CoM momentum",
                "Linear, and angular about the centre of mass, in world axes.",
                momentum_panels(predictions, look),
                legend,
            ),
        ]
    if content.link_errors is not None:
        sections.append(
            FigureSection(
                "links",
                "Error per link",
                "Mean relative error of each link's inertial parameters.",
                (link_error_panel(content.link_errors, look),),
                {},
            )
        )
    return tuple(sections)


def impossible_links(consistent: dict[str, bool]) -> tuple[str, ...]:
    """Return the links whose mass or pseudo-inertia no body can have."""
    return tuple(link for link, possible in consistent.items() if not possible)


def headline(content: ReportContent) -> str:
    """Return the verdict on the chosen method, computed from its numbers."""
    estimate = content.estimate
    clauses = []
    own, prior = content.metrics_of(content.chosen), content.metrics_of(PRIOR)
    key = "com_position_rmse_mm"
    if own is not None and key in own:
        error = own[key]
        clause = f"CoM error {significant(error)} mm"
        if prior is not None and key in prior:
            against = "against" if error < prior[key] else "no better than"
            clause += f" {against} {significant(prior[key])} mm of the prior"
        clauses.append(clause)
    if estimate.determined is not None:
        clauses.append(
            f"{int(estimate.determined.sum())} of {len(estimate.names)} parameters "
            "determined by the data"
        )
    possible = len(estimate.consistent) - len(impossible_links(estimate.consistent))
    clauses.append(f"{possible} of {len(estimate.consistent)} links physically possible")
    return f"{content.chosen}: {'; '.join(clauses)}."
