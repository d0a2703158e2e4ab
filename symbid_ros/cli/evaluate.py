"""``symbid evaluate``."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from symbid_ros.cli.flags import BaseKind


def evaluate(
    subject: Annotated[Path, typer.Argument(help="Folder of an identification, or a prior.json.")],
    model: Annotated[Path, typer.Option(help="The true robot, URDF or MJCF.")],
    bag: Annotated[list[Path], typer.Option(help="Ideal bag with ground truth.")],
    realistic: Annotated[
        list[Path] | None,
        typer.Option(
            help="Noisy bag with ground truth: predict it also from its sensors, with velocities "
            "filtered in real time and contact forces by the thesis's Eq. 4.1."
        ),
    ] = None,
    velocity_cutoff: Annotated[
        float, typer.Option(help="Hz, of the velocities of --realistic; 0: no filter.")
    ] = 50.0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="File to write the figures to.")
    ] = None,
    base: BaseKind = "auto",
) -> None:
    """Judge an estimate or a prior against the truth of a simulated bag."""
    from symbid_ros.atomic_write import check_output_file, write_text
    from symbid_ros.identification.evaluation import evaluate as judge
    from symbid_ros.identification.intervals import LEVEL, summarise_intervals
    from symbid_ros.identification.realistic_prediction import evaluate_realistic
    from symbid_ros.identification.result_files import load_estimated_model
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
    from symbid_ros.signals.filters import CausalLowPass

    low_pass = CausalLowPass(velocity_cutoff)
    if json_file is not None:
        check_output_file(json_file)
    robot = load_model(model, base)
    found = load_estimated_model(subject, robot)
    parameters, values, factor = found.parameters, found.values, found.deviation_factor
    motion = read_true_motion(bag, robot)
    noisy = read_realistic_motion(realistic, robot, low_pass) if realistic else None
    candidates = {"it": values}
    ideal = asdict(judge(parameters, candidates, parameters.values, motion)["it"])
    figures: dict[str, object] = dict(ideal)
    tables = [_table("", ideal)]
    if factor is not None:
        summary = summarise_intervals(parameters, values, factor, parameters.values, motion)
        figures["intervals"] = asdict(summary)
        tables.append(_table(f"{100 * LEVEL:g} % intervals", asdict(summary)))
    if noisy is not None:
        judged = evaluate_realistic(parameters, candidates, parameters.values, noisy)["it"]
        figures["realistic"] = asdict(judged)
        tables.append(_table("from noisy sensors", asdict(judged)))
    Console().print(*tables, sep="\n")
    if json_file is not None:
        write_text(json_file, json.dumps(figures, indent=1) + "\n")


def _table(title: str, metrics: Mapping[str, float]) -> Table:
    table = Table(show_header=False, title=title, title_justify="left")
    for name, value in metrics.items():
        table.add_row(name, f"{value:.4g}")
    return table
