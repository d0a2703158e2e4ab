"""``symbid identify``."""

from pathlib import Path
from typing import Annotated

import typer

from symbid_ros.cli.flags import BaseKind, Model, with_flags
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions


@with_flags
def identify(
    bags: Annotated[list[Path], typer.Argument(help="Bags of one robot.", show_default=False)],
    model: Model,
    out: Annotated[Path, typer.Option(help="Folder for the estimate and the identified models.")],
    options: IdentifyOptions,
    log: LogOptions,
    base: BaseKind = "auto",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the result of an earlier run in --out.")
    ] = False,
) -> None:
    """Identify a robot's parameters from bags.

    All links come out physically possible, and each number has a standard deviation.

    The log is checked first, as by `symbid bag doctor`. The verdict states what the data
    determined; alarms come first.

    Exit status: 0 written, 1 written with alarms: do not trust the numbers yet, 2 nothing written.
    """
    from symbid_ros.cli.overwriting import require_no_files
    from symbid_ros.cli.tables import print_estimate
    from symbid_ros.identification.result_files import RESULT_FILES, write_identification
    from symbid_ros.offline.bags import BagRequest

    require_no_files(out, RESULT_FILES, overwrite=overwrite)
    problem = BagRequest(tuple(bags), model, options, log, base).load(out)
    found = problem.solve()
    write_identification(found, problem.parameters, out)
    print_estimate(found.estimate, out)
    verdict = found.estimate.verdict
    if verdict is not None and verdict.alarms:
        raise typer.Exit(1)
