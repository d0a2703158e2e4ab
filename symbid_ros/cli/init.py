"""``symbid init``."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from symbid_ros.cli.flags import BaseKind
from symbid_ros.cli.verbosity import progress_shown


def init(
    model: Annotated[
        Path,
        typer.Option(
            help="Robot model: URDF, MJCF or xacro, whose URDF is written beside the robot file."
        ),
    ],
    bag: Annotated[list[Path] | None, typer.Option(help="Bag of the robot. Repeatable.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Robot file to write, such as robot.yaml.")
    ] = None,
    foxglove: Annotated[
        Path | None,
        typer.Option(
            help="Foxglove layout to write, such as layout.json: the robot in 3D with its live "
            "estimate. --bag and --out may then be left out."
        ),
    ] = None,
    base: BaseKind = "auto",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files of these names.")
    ] = False,
) -> None:
    """Write a robot file: how topics, names, signs and units of a log differ from the model.

    With --foxglove it writes a layout for Foxglove that suits the robot.

    Guesses are marked CHECK. `symbid identify`, `validate` and `bag doctor` read the file
    with --robot, the node `identifier` with --params-file.

    Exit status: 0 the log is usable as the file says, 1 correct the file first, 2 error.
    """
    from symbid_ros.atomic_write import check_output_file, require_distinct, write_text
    from symbid_ros.cli.foxglove import layout_text
    from symbid_ros.errors import OptionError
    from symbid_ros.model.load import load_model
    from symbid_ros.model.urdf import expanded_name
    from symbid_ros.offline.robot_setup import expand_xacro, inspect_robot

    if (bag is None) != (out is None) or (out is None and foxglove is None):
        raise OptionError(
            "a robot file needs `bag`, the log to look at, and `out`, the file to write; give "
            "both, or `foxglove` alone",
            "E585",
        )
    is_xacro = model.suffix == ".xacro"
    files = [file for file in (out, foxglove) if file is not None]
    urdf = files[0].parent / expanded_name(model) if is_xacro else model
    paths = {"`model`": model, "`out`": out, "`foxglove`": foxglove}
    if is_xacro:
        paths["the URDF of `model`"] = urdf
    require_distinct(paths)
    for file in files:
        check_output_file(file, lambda _: overwrite, "give `overwrite`")
    is_new = is_xacro and not urdf.exists()
    if is_xacro:
        text = expand_xacro(model)

        def is_same(file: Path) -> bool:
            with suppress(OSError, UnicodeDecodeError):
                return file.read_text(encoding="utf-8") == text
            return False

        remedy = f"give `overwrite` if the URDF of {model} may replace it"
        check_output_file(urdf, lambda file: overwrite or is_same(file), remedy)
        write_text(urdf, text)
    console = Console(soft_wrap=True)
    try:
        with progress_shown():
            setup = None if bag is None else inspect_robot(urdf, bag, base)
        layout = None if foxglove is None else layout_text(load_model(urdf, base))
    except BaseException:
        if is_new:  # it would be in the way of the next attempt
            urdf.unlink(missing_ok=True)
        raise
    if foxglove is not None and layout is not None:
        write_text(foxglove, layout)
        console.print(f"wrote {foxglove}", markup=False, highlight=False)
    if setup is None or out is None:
        return
    setup.write(out)
    for name, values in setup.options.items():
        console.print(f"{name}: {', '.join(values)}", markup=False, highlight=False)
    for lines in setup.comments.values():
        for line in lines:
            console.print(line, markup=False, highlight=False)
    console.print(f"wrote {out}", markup=False, highlight=False)
    if not setup.is_usable:
        raise typer.Exit(1)
