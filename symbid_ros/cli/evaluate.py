"""``symbid evaluate``."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from symbid_ros.cli.options import BaseKind


def evaluate(
    subject: Annotated[Path, typer.Argument(help="Folder of an identification, or a prior.json.")],
    model: Annotated[Path, typer.Option(help="The true robot, URDF or MJCF.")],
    bag: Annotated[list[Path], typer.Option(help="Ideal bag with ground truth.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="File to write the figures to.")
    ] = None,
    base: BaseKind = "auto",
) -> None:
    """Judge an estimate or a prior against the truth of a simulated bag."""
    from symbid_ros.atomic import write_text
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.evaluation import evaluate as judge
    from symbid_ros.offline.evaluation import read_true_motion
    from symbid_ros.offline.subject import load_subject

    robot = load_model(model, base)
    parameters, values = load_subject(subject, robot)
    motion = read_true_motion(bag, robot)
    metrics = asdict(judge(parameters, {"it": values}, parameters.values, motion)["it"])
    if json_file is not None:
        write_text(json_file, json.dumps(metrics, indent=1) + "\n")
    table = Table(show_header=False)
    for name, value in metrics.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)
