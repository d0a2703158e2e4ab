"""``symbid bag``: what is in a bag, what is wrong with it, and how to save a damaged one."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from symbid_ros.cli.flags import BaseKind, with_flags
from symbid_ros.messages.log_options import LogOptions

if TYPE_CHECKING:
    from symbid_ros.diagnosis.findings import Diagnosis

app = typer.Typer(help="Look into bags, judge them and recover damaged ones.", no_args_is_help=True)

Bag = Annotated[Path, typer.Argument(help="A bag's folder or file.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]


@app.command()
def info(bag: Bag, as_json: Json = False) -> None:
    """Show files, topics and times of a bag, finished or not."""
    from symbid_ros.bags import bag_info
    from symbid_ros.cli.tables import print_info

    found = bag_info(bag)
    if as_json:
        typer.echo(json.dumps(found.as_dict(), indent=1))
    else:
        print_info(found)


@app.command()
def recover(
    bag: Bag,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the new bag. Default: beside the old one, its name with _recovered.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Save what an interrupted or damaged bag holds into a new one, and count what is lost.

    The bag itself is left as it is. Exit status: 0 nothing lost, 1 something, 2 everything.
    """
    from symbid_ros.bags import recover as recover_bag
    from symbid_ros.cli.tables import print_recovery

    found = recover_bag(bag, out)
    if as_json:
        typer.echo(json.dumps(found.as_dict(), indent=1))
    else:
        print_recovery(found)
    if not found.is_whole:
        raise typer.Exit(1)


@app.command()
@with_flags
def doctor(
    bags: Annotated[
        list[Path],
        typer.Argument(help="Bags that continue one another.", show_default=False),
    ],
    log: LogOptions,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Robot model, URDF or MJCF; without it each stream is judged by itself alone.",
            show_default=False,
        ),
    ] = None,
    base: BaseKind = "auto",
    as_json: Json = False,
) -> None:
    """Judge whether a log serves to identify a robot, stream by stream and against its model.

    Exit status: 0 clean, 1 warnings, 2 unusable.
    """
    from symbid_ros.diagnosis.doctor import diagnose
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import load_bag

    robot = None if model is None else load_model(model, base)
    found = diagnose(load_bag(bags, robot, log), robot)
    print_verdict(found, as_json=as_json)
    if found.severity:
        raise typer.Exit(int(found.severity))


def print_verdict(diagnosis: "Diagnosis", *, as_json: bool) -> None:
    """Print what the doctor found, as JSON or as tables."""
    from symbid_ros.cli.tables import print_diagnosis

    if as_json:
        typer.echo(json.dumps(diagnosis.as_dict(), indent=1))
    else:
        print_diagnosis(diagnosis)
