"""Report on one estimate, or a comparison of several, as a self-contained HTML page."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.atomic_write import write_text
from symbid_ros.identification.report_data import ForceSeries
from symbid_ros.report.content import (
    METRICS,
    REALISTIC_METRICS,
    MethodResult,
    ReportContent,
    best_labels,
)
from symbid_ros.report.data_summary import (
    identified_base,
    link_rows,
    parameter_groups,
    verdict_entries,
)
from symbid_ros.report.figures import (
    TORQUES_SHOWN,
    Panel,
    com_signals,
    link_error_panel,
    momentum_signals,
    signal_panels,
    torque_signals,
)
from symbid_ros.report.first_screen import describe_combinations, error_bars, key_figures, recommend
from symbid_ros.report.formatting import significant
from symbid_ros.report.interactive import figure_css, figure_data, figure_script, script_json
from symbid_ros.report.log_bars import joint_ranges, timeline
from symbid_ros.report.log_figures import (
    base_panels,
    drawn_forces,
    force_panels,
    has_block_gaps,
    has_hidden_errors,
    shown_joints,
    spectrum_panels,
    speed_panels,
)
from symbid_ros.report.matrices import correlation_image, determined_matrices, largest_changes
from symbid_ros.report.plotting import Style, colour_variable, styles
from symbid_ros.report.robot_view import robot_view
from symbid_ros.report.shown_log import describe_given, describe_identified_log, given_options
from symbid_ros.report.side_by_side import compared_results
from symbid_ros.report.templates import page_template, shared_css

# Links to the pages that explain a section.
DOCUMENTATION = "https://symbid-ros.github.io/symbid_ros"

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
    """Return the page as HTML without external resources.

    Figures are static; a script in the page replaces those of the log by ones that can be zoomed.
    """
    filters = {
        "unbroken": lambda direction: _COEFFICIENT.sub(_unbroken, direction),
        "variable": colour_variable,
        "option_text": option_text,
    }
    errors = {method.label: method.metrics or {} for method in content.methods}
    estimate, summary = content.estimate, content.shown.summary
    com_std = {} if summary is None else summary.link_com_std
    log, given = content.shown.drawn, content.shown.given
    forces = drawn_forces(log)
    prior_std = None if content.spread is None else content.spread.prior_std
    data = figure_data(content)
    robot = None if content.robot is None else robot_view(content.robot)
    scripts = [figure_script()] if data else []
    if robot is not None:
        scripts.append(robot.script)
    shown: dict[str, Any] = {
        "content": content,
        "title": content.title,
        "docs": DOCUMENTATION,
        "css": "\n".join([figure_css(), *([robot.style] if robot else []), shared_css()]),
        "subtitle": " · ".join(_subtitle(content)),
        "recommendation": recommend(estimate),
        "key_figures": key_figures(content),
        "bars": error_bars(content.shown),
        "robot_picture": robot.still_svg if robot else "",
        "robot_view": robot.html if robot else "",
        "missing_boxes": _missing_boxes(content),
        "verdict": estimate.verdict,
        "measured": describe_combinations(estimate),
        "base": identified_base(estimate),
        "entries": verdict_entries(estimate),
        "links": link_rows(estimate, com_std),
        "has_com": bool(com_std),
        "matrices": determined_matrices(estimate, prior_std),
        "correlation": None if content.spread is None else correlation_image(content.spread),
        "changes": largest_changes(estimate, prior_std),
        "compared": None if any(errors.values()) else compared_results(content.results),
        "forces": None if forces is None else _forces(content.shown, forces),
        "log": None if log is None else log.coverage,
        "is_given": given is not None,
        "origin": _origin(content),
        "timeline": None
        if log is None
        else timeline(log.coverage, log.forces, "used" if given is None else "with data"),
        "ranges": () if log is None else joint_ranges(log.coverage, content.limits),
        "missing": _missing(content.shown),
        "metrics": METRICS if any(errors.values()) else (),
        "errors": errors,
        "best": best_labels(errors, METRICS),
        "realistic": REALISTIC_METRICS if content.realistic else (),
        "best_realistic": best_labels(content.realistic, REALISTIC_METRICS),
        "figures": _figures(content),
        "impossible": {
            result.label: result.estimate.impossible_links
            for result in content.results
            if result.estimate is not None
        },
        "estimates": {result.label: result.estimate for result in content.results},
        "groups": parameter_groups(estimate),
        "provenance": estimate.provenance,
        "figure_json": script_json(data) if data else "",
        "scripts": scripts,
    }
    return page_template("report.html", filters=filters).render(shown, sections=_sections(shown))


def _subtitle(content: ReportContent) -> tuple[str, ...]:
    estimate, log = content.estimate, content.shown.log
    parts = [content.model, content.chosen]
    if log is not None:
        parts.append(log.coverage.log)
    if estimate.provenance is not None and estimate.provenance.date:
        parts.append(estimate.provenance.date.partition("T")[0])
    return tuple(parts)


def _sections(shown: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return anchors and titles of the sections that the page has."""
    every: list[tuple[Any, str, str]] = [
        (shown["compared"], "compared", "Side by side"),
        (shown["forces"], "forces", "Forces"),
        (shown["content"].payloads, "payload", "Payload"),
        (shown["robot_view"], "robot", "The robot"),
        (shown["metrics"], "methods", "Methods"),
        *((True, figure.anchor, figure.title) for figure in shown["figures"]),
        (shown["realistic"], "realistic", "From the robot’s own sensors"),
        (shown["content"].truncations, "truncation", "Choice of z"),
        (shown["verdict"], "data-summary", "What the data determine"),
        (shown["log"], "log", "The given bag" if shown["is_given"] else "The log"),
        (True, "possible", "Physical consistency"),
        (True, "parameters", "Parameters"),
        (True, "data", "Origin"),
    ]
    return tuple((anchor, title) for is_there, anchor, title in every if is_there)


@dataclass(frozen=True)
class ForcePanels:
    """Static figures of measured and predicted forces."""

    caption: str
    base: str
    choice: str  # which joints the static figures show; empty if all
    force_panels: tuple[Panel, ...]
    speed_panels: tuple[Panel, ...]
    spectrum_panels: tuple[Panel, ...]
    base_panels: tuple[Panel, ...]


def _missing_boxes(content: ReportContent) -> str:
    """Return the links whose original inertia has no box, as a sentence; may be empty."""
    links = () if content.robot is None else content.robot.links
    original = dict(zip(content.estimate.names, content.estimate.prior.tolist(), strict=True))
    missing = [link.name for link in links if link.before is None and original[f"{link.name}/m"]]
    if not missing:
        return ""
    which = f"{len(missing)} of {len(links)} links" if len(missing) > 3 else ", ".join(missing)
    return f"Without a box of the original model, whose inertia no rigid body has: {which}."


def _origin(content: ReportContent) -> dict[str, str]:
    """Return the log of the identification, and what else describes data and processing."""
    shown = content.shown
    identified = {} if shown.log is None else {"Log": describe_identified_log(shown)}
    return identified | content.metadata


def _forces(result: MethodResult, forces: ForceSeries) -> ForcePanels:
    given, estimate = result.given, result.estimate
    assert estimate is not None
    assert result.drawn is not None
    holdout = estimate.holdout
    seconds = significant(forces.stop - forces.start)
    if forces.is_held_out:
        # As in the summary of the trial; rows start and end half a window within.
        seconds = seconds if holdout is None else f"{holdout.seconds:.0f}"
        what = (
            f"The last {seconds} s of the log, predicted by a trial identification that left them "
            "out."
        )
    else:
        which = "the log, which the identification used" if given is None else describe_given(given)
        what = f"{seconds} s of {which}, predicted by the identified model."
    shown = forces.time[-1] - forces.time[0] if len(forces.time) else 0.0
    if shown < 0.9 * (forces.stop - forces.start):
        what += f" Shown are the {significant(float(shown))} s in which forces change most."
    what += " The errors have their own scale."
    if given is None and (start := given_options(estimate).get("start")):
        what += f" Time counts from the start of the part that was read, {start:g} s into the bag."
    if has_block_gaps(forces, result.drawn.coverage):
        what += (
            " The short gaps in the curves are normal: forces are averaged within blocks of data, "
            "of 4 s in most logs, and not across their borders."
        )
    if np.isnan(forces.measured[:, forces.has_rows]).any():
        what += " Curves have no points where a joint rests or its effort is not used."
    if has_hidden_errors(forces):
        what += " Errors of the original model that exceed the measured force are cut off."
    return ForcePanels(
        what,
        "the base",
        _describe_choice(forces),
        force_panels(forces),
        speed_panels(forces),
        spectrum_panels(forces),
        base_panels(forces),
    )


def _describe_choice(forces: ForceSeries) -> str:
    shown = shown_joints(forces)
    count = sum(
        not name.startswith("base/") and bool(has_rows)
        for name, has_rows in zip(forces.coordinates, forces.has_rows.tolist(), strict=True)
    )
    if count <= len(shown):
        return ""
    return f"Shown are the {len(shown)} of {count} joints with the largest errors in percent."


def _missing(result: MethodResult) -> str:
    """Return what a result without data of its log lacks, as HTML."""
    if result.drawn is None:
        what = "measured forces, errors, and the motion of the log"
    elif drawn_forces(result.drawn) is None:
        what = "measured forces and errors, because the log is too short"
    else:
        return ""
    return (
        f"This result does not hold {what}. Identify the log again, or name a bag: "
        "<code>symbid report RESULT --bag BAG</code>."
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


def option_text(value: Any) -> str:
    """Return the value of an option as text."""
    if value is None or value in ([], ""):
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
