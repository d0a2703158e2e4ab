"""``symbid validate`` and ``symbid compare``."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from symbid_ros.cli.flags import Robot, with_flags
from symbid_ros.cli.verbosity import progress_shown
from symbid_ros.errors import SymbidError
from symbid_ros.messages.log_options import LogOptions

HeldOut = Annotated[
    list[Path],
    typer.Option(help="Bag that the identification did not use. Repeatable."),
]
Carried = Annotated[
    list[str] | None,
    typer.Option(
        help="Payload LINK,MASS,X,Y,Z (kg; m in the link's axes) that the robot carries in the "
        "bag; LINK,MASS if the identification found its place. Repeatable.",
        metavar="PAYLOAD",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]


@with_flags
def validate(
    result: Annotated[
        Path, typer.Argument(help="Folder of an identification.", show_default=False)
    ],
    bag: HeldOut,
    log: LogOptions,
    robot: Robot = None,
    predictions: Annotated[
        Path | None,
        typer.Option(help="Bag folder to write measured and predicted efforts to."),
    ] = None,
    payload: Carried = None,
    as_json: Json = False,
) -> None:
    """Test an identified robot on a log that was not used; no ground truth is needed.

    Torques of the original and of the identified model are predicted from the measured motion,
    and compared with the measured ones. The bag is read like that of the identification, with the
    same topics, names and units, unless flags or a robot file say otherwise.

    Exit status: 0 use it, 1 not better than the original model or not fit for this robot or load,
    2 error.
    """
    from symbid_ros.atomic_write import check_writable
    from symbid_ros.cli.tables import print_validation
    from symbid_ros.identification.predictions.validation import validate as judge
    from symbid_ros.offline.bags import load_bag
    from symbid_ros.offline.predictions import write_predictions

    if predictions is not None and os.path.lexists(predictions):
        raise SymbidError(
            f"{predictions}: exists; choose another --predictions, or remove it", "E551"
        )
    if predictions is not None:
        check_writable(predictions)
    with progress_shown():
        held_out = load_bag(bag, options=as_identified(log, [result]))
        found = judge(result, held_out, payload=payload or ())
    if predictions is not None:
        write_predictions(found.efforts, predictions)
    if as_json:
        typer.echo(json.dumps(found.document(), indent=1))
    else:
        print_validation(found)
    if not found.is_recommended:
        raise typer.Exit(1)


@with_flags
def compare(
    results: Annotated[
        list[Path], typer.Argument(help="Folders of identifications.", show_default=False)
    ],
    bag: HeldOut,
    log: LogOptions,
    robot: Robot = None,
    payload: Carried = None,
    as_json: Json = False,
) -> None:
    """Rank identifications of one robot by their error on a log that none of them used.

    All are compared on the same rows: windows of the longest length among them that are valid for
    each. The bag is read like those of the identifications, as far as these agree.

    Exit status: 0 one is recommended, 1 none is better than the original model and fit for this
    robot and load, 2 error.
    """
    from symbid_ros.cli.tables import print_comparison
    from symbid_ros.identification.predictions.comparison import compare as rank
    from symbid_ros.offline.bags import load_bag

    with progress_shown():
        held_out = load_bag(bag, options=as_identified(log, results))
        found = rank(results, held_out, payload=payload or ())
    if as_json:
        typer.echo(json.dumps(found.document(), indent=1))
    else:
        print_comparison(found)
    if found.recommended is None:
        raise typer.Exit(1)


def as_identified(log: LogOptions, results: list[Path]) -> LogOptions:
    """Return options of a log with those of identifications where none are given.

    Only options on which all results agree are taken from them.

    Raises
    ------
    SymbidError
        When a result is missing or malformed.
    """
    from symbid_ros.estimation.estimate_file import load_estimate

    found = [load_estimate(folder / "estimate.json").provenance for folder in results]
    recorded = [{} if one is None else one.options for one in found]
    first, *others = recorded
    shared = {
        name: value
        for name, value in first.items()
        if all(name in other and other[name] == value for other in others)
    }
    return log.of_same_robot(shared)
