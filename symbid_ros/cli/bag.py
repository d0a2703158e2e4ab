"""The commands ``bag info``, ``bag recover`` and ``bag doctor``."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from symbid_ros.cli.flags import LogBaseKind, Robot, with_flags
from symbid_ros.cli.verbosity import progress_shown, with_verbosity
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.messages.log_options import LogOptions

if TYPE_CHECKING:
    from symbid_ros.diagnosis.findings import Diagnosis

app = typer.Typer(help="Describe, check and recover bags.", no_args_is_help=True)

Bag = Annotated[Path, typer.Argument(help="A bag's folder or file.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]


@app.command()
@with_verbosity
def info(bag: Bag, as_json: Json = False) -> None:
    """Show files, topics and times of a bag, complete or interrupted."""
    from symbid_ros.bags import bag_info
    from symbid_ros.cli.tables import print_info

    found = bag_info(bag)
    if as_json:
        typer.echo(json.dumps(found.as_dict(), indent=1))
    else:
        print_info(found)


@app.command()
@with_verbosity
def recover(
    bag: Bag,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the new bag. Default: that of the bag, with _recovered appended.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Copy the intact messages of an interrupted or damaged bag to a new bag; count lost ones.

    The bag itself is not changed. Exit status: 0 nothing lost, 1 data lost, 2 nothing recovered.
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
@with_verbosity
@with_flags
def doctor(
    *,
    bags: Annotated[
        list[Path],
        typer.Argument(help="Bags of one robot.", show_default=False),
    ],
    log: LogOptions,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Robot model, URDF or MJCF. Default: each stream is checked by itself.",
            show_default=False,
        ),
    ] = None,
    robot: Robot = None,
    base: LogBaseKind = "auto",
    contacts: RobotOptions,
    as_json: Json = False,
) -> None:
    """Check whether a log is suitable for identification: each stream, and all against the model.

    Exit status: 0 clean, 1 warnings, 2 unusable.
    """
    from symbid_ros.identification.api import diagnose
    from symbid_ros.offline.bags import load_robot, open_bags, with_wrench_topics

    loaded = None if model is None else load_robot(model, base, bags)
    if loaded is not None:
        log = with_wrench_topics(
            log,
            loaded,
            bags,
            has_contacts=bool(contacts.contacts),
            wrist_sensors=contacts.wrist_sensors,
        )
    with progress_shown():
        found = diagnose(loaded, open_bags(bags, loaded, log), contacts)
    print_verdict(found, as_json=as_json)
    if found.severity:
        raise typer.Exit(int(found.severity))


def print_verdict(diagnosis: "Diagnosis", *, as_json: bool) -> None:
    """Print the findings of the doctor as JSON or as tables."""
    from symbid_ros.cli.tables import print_diagnosis

    if as_json:
        typer.echo(json.dumps(diagnosis.as_dict(), indent=1))
    else:
        print_diagnosis(diagnosis)
