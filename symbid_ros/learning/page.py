"""The page of a robot that learns, and its figures as files."""

import base64
from collections.abc import Mapping
from pathlib import Path

from symbid_ros.atomic_write import write_text, write_through
from symbid_ros.learning.figures import (
    ALONE,
    COLOURS,
    LEARNING,
    TRUE,
    LearningFigure,
    learning_figures,
)
from symbid_ros.learning.lockstep import LearningRecord
from symbid_ros.learning.model_update import ACCEPTED
from symbid_ros.learning.stick_figure import AFTER, Actor, animation
from symbid_ros.model.tree import RobotModel
from symbid_ros.report.formatting import with_std
from symbid_ros.report.plotting import figure_style, inline_svg
from symbid_ros.report.templates import page_template, shared_css
from symbid_ros.simulation.scenario import SOLES

LAST = 10.0  # s at the end, over which errors are stated
SHOWN = 6.0  # s before the fall that the animation shows
DPI = 160


def summary_rows(runs: Mapping[str, LearningRecord]) -> list[tuple[str, list[str]]]:
    """Return a row of text for each property of the runs, one cell for each run."""
    records = list(runs.values())

    def over_the_end(name: str, factor: float, unit: str) -> list[str]:
        cells = []
        for record in records:
            stop = float(record.time[-1])
            value = factor * getattr(record, name)(stop - LAST, stop)
            cells.append("–" if record.fall else f"{value:.1f} {unit}")
        return cells

    return [
        ("outcome", [outcome(record) for record in records]),
        (f"CoM error, last {LAST:g} s", over_the_end("com_error", 1e3, "mm")),
        (f"feed-forward, last {LAST:g} s", over_the_end("feed_forward_share", 1e2, "%")),
        (
            "models taken over",
            [str(sum(event.kind == ACCEPTED for event in record.events)) for record in records],
        ),
    ]


def outcome(record: LearningRecord) -> str:
    """Return when a robot fell, or how long it has stood."""
    if record.fall is None:
        return f"stands {record.time[-1]:.0f} s"
    return f"falls at {record.fall.time:.1f} s"


def event_text(record: LearningRecord, time: float, kind: str, text: str) -> str:
    """Return one line about an event of a run."""
    if kind == ACCEPTED:
        known = min(record.estimates, key=lambda one: abs(one.time - time))
        return (
            f"takes over a model: mass {with_std(known.mass, known.mass_std)} kg, centre of mass "
            f"± {1e3 * known.com_std:.2g} mm"
        )
    return f"{kind}: {text}" if text else kind


def robot_animation(model: RobotModel, runs: Mapping[str, LearningRecord]) -> str:
    """Return the animation of the robot with the file alone beside the one that learns, as SVG.

    It shows the seconds before the first one falls, or the last seconds.
    """
    alone = runs[ALONE]
    decided = float(alone.time[-1] if alone.fall is None else alone.fall.time)
    actors = {}
    for title, label in (
        ("with the wrong model alone", ALONE),
        ("learning its own model", LEARNING),
    ):
        record = runs[label]
        since = decided if record.fall is None else record.fall.time
        text = f"still stands after {record.time[-1]:.0f} s"
        caption = text if record.fall is None else outcome(record)
        actors[title] = Actor(record, COLOURS[label], caption, since)
    return animation(model, SOLES, actors, max(0.0, decided - SHOWN), decided + AFTER)


def write_learning_report(
    folder: Path,
    model: RobotModel,
    runs: Mapping[str, LearningRecord],
    facts: Mapping[str, str],
) -> None:
    """Write ``report.html``, ``robots.svg`` and each figure as SVG and PNG, atomically.

    Parameters
    ----------
    folder : Path
    model : RobotModel
        Kinematics of the robot.
    runs : mapping of str to LearningRecord
        Labelled as in :mod:`symbid_ros.learning.figures`.
    facts : mapping of str to str
        About the run, shown at the end of the page.
    """
    figures = learning_figures(runs)
    picture = robot_animation(model, runs)
    write_text(folder / "robots.svg", picture)
    for each in figures:
        _write_figure(each, folder)
    write_text(folder / "report.html", _render(model, runs, facts, figures, picture))


def _write_figure(drawn: LearningFigure, folder: Path) -> None:
    with figure_style():
        for suffix in ("svg", "png"):
            write_through(
                folder / f"{drawn.name}.{suffix}",
                lambda stream, kind=suffix: drawn.figure.savefig(  # type: ignore[misc]
                    stream, format=kind, dpi=DPI, metadata={"Date": None} if kind == "svg" else None
                ),
            )


def _render(
    model: RobotModel,
    runs: Mapping[str, LearningRecord],
    facts: Mapping[str, str],
    figures: tuple[LearningFigure, ...],
    picture: str,
) -> str:
    learning = runs[LEARNING]
    with figure_style():
        drawn = [
            (
                each.title,
                each.description,
                inline_svg(each.figure, each.name.replace("_", "-"), each.description),
            )
            for each in figures
        ]
    return page_template("learning.html", "symbid_ros.learning").render(
        title=f"{model.name} learns its own model",
        css=shared_css(),
        model=model.name,
        verdict=verdict(runs),
        picture=base64.b64encode(picture.encode()).decode(),
        labels=list(runs),
        rows=summary_rows(runs),
        figures=drawn,
        events=[
            (f"{event.time:.1f} s", event_text(learning, event.time, event.kind, event.text))
            for event in learning.events
        ],
        facts=facts,
    )


def verdict(runs: Mapping[str, LearningRecord]) -> str:
    """Return one sentence on what happened."""
    alone, learning = runs[ALONE], runs[LEARNING]
    first = "stands" if alone.fall is None else f"falls after {alone.fall.time:.1f} s"
    second = "stands" if learning.fall is None else f"falls after {learning.fall.time:.1f} s"
    is_contrast = (alone.fall is None) != (learning.fall is None)
    text = f"With the wrong model alone the robot {first}"
    text += (
        f"; learning its own, it {second}" if is_contrast else f", learning as well: it {second}"
    )
    if learning.fall is None and TRUE in runs:
        stop = float(learning.time[-1])
        ratio = learning.com_error(stop - LAST, stop) / runs[TRUE].com_error(stop - LAST, stop)
        text += (
            f" and in the last {LAST:g} s tracks its centre of mass with {ratio:.2f} times the "
            "error of a controller that knows the true model"
        )
    return text + "."
