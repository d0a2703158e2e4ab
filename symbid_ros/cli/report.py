"""``symbid report``."""

from pathlib import Path
from typing import Annotated

import typer

from symbid_ros.cli.flags import BaseKind, Model


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
    realistic: Annotated[
        list[Path] | None,
        typer.Option(
            help="Noisy bag with ground truth, to predict from its sensors; needs --truth."
        ),
    ] = None,
    base: BaseKind = "auto",
) -> None:
    """Render identifications as one self-contained page."""
    from symbid_ros.atomic_write import check_output_file
    from symbid_ros.errors import EstimateError
    from symbid_ros.identification.result_files import load_estimated_model
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet
    from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
    from symbid_ros.report.compose import (
        METHOD_TITLES,
        GroundTruth,
        compose,
        describe_bags,
        describe_estimate,
    )
    from symbid_ros.report.page import write_report

    if realistic and truth is None:
        raise EstimateError("--realistic needs the true model to compare with; add --truth", "E556")
    check_output_file(out)
    robot = load_model(model, base)
    subjects = {folder: load_estimated_model(folder, robot) for folder in folders}
    estimates = {}
    for folder, subject in subjects.items():
        if subject.estimate is None:
            raise EstimateError(
                f"{folder}: holds a prior; give the folder of an identification", "E556"
            )
        title = METHOD_TITLES.get(subject.estimate.method, subject.estimate.method)
        label = title if title not in estimates else f"{title}, {folder}"
        estimates[label] = subject.estimate
    chosen, subject = list(estimates)[-1], list(subjects.values())[-1]
    ground_truth = None
    if truth is not None:
        true_robot = load_model(truth, base)
        noisy = read_realistic_motion(realistic, true_robot) if realistic else None
        values = ParameterSet(true_robot, subject.parameters.terms).values
        ground_truth = GroundTruth(read_true_motion(bag, true_robot), values, noisy)
    content = compose(
        estimates,
        subject.parameters,
        chosen=chosen,
        metadata=describe_bags(bag) | describe_estimate(estimates[chosen]),
        ground_truth=ground_truth,
        deviation_factor=subject.deviation_factor,
    )
    write_report(content, out)
    typer.echo(f"wrote {out}")
