"""``symbid report``."""

from pathlib import Path
from typing import Annotated

import typer

from symbid_ros.cli.options import BaseKind, Model


def report(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of identifications; the last is shown in full.")
    ],
    model: Model,
    bag: Annotated[list[Path], typer.Option(help="Bag to report on, in sequence if several.")],
    out: Annotated[Path, typer.Option(help="HTML file to write.")],
    truth: Annotated[
        Path | None, typer.Option(help="True model, to judge by a bag with ground truth.")
    ] = None,
    base: BaseKind = "auto",
) -> None:
    """Render identifications as one self-contained page."""
    from symbid_ros.estimation.estimate import load_estimate
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet
    from symbid_ros.offline.evaluation import read_true_motion
    from symbid_ros.offline.subject import load_subject
    from symbid_ros.report.compose import TITLES, Reference, compose
    from symbid_ros.report.facts import bag_facts, estimate_facts
    from symbid_ros.report.page import write_report

    robot = load_model(model, base)
    estimates = {}
    for folder in folders:
        estimate = load_estimate(folder / "estimate.json" if folder.is_dir() else folder)
        estimates[TITLES.get(estimate.method, estimate.method)] = estimate
        parameters, _ = load_subject(folder, robot)
    chosen = list(estimates)[-1]
    reference = None
    if truth is not None:
        true_robot = load_model(truth, base)
        values = ParameterSet(true_robot, parameters.terms).values
        reference = Reference(read_true_motion(bag, true_robot), values)
    facts = bag_facts(bag) | estimate_facts(estimates[chosen])
    write_report(
        compose(estimates, parameters, chosen=chosen, facts=facts, reference=reference), out
    )
    typer.echo(f"wrote {out}")
