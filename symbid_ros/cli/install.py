"""The commands ``diff`` and ``apply``: what an identification changed, and its way into files."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from symbid_ros.errors import EstimateError

if TYPE_CHECKING:
    from symbid_ros.identification.link_changes import Change, RobotChange

Result = Annotated[Path, typer.Argument(help="Folder of an identification.", show_default=False)]


def diff(
    result: Result,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of tables.")
    ] = False,
) -> None:
    """Show the changes of each link's mass, centre of mass and inertia by an identification.

    The columns are the original robot, the identified robot and its standard deviations.

    A star marks changes of more than two standard deviations.
    """
    from symbid_ros.identification.link_changes import robot_change

    found = robot_change(result)
    if as_json:
        typer.echo(json.dumps(found.document(), indent=1))
    else:
        print_change(found)


def apply(
    result: Result,
    robot: Annotated[
        Path | None,
        typer.Argument(
            help="URDF or MJCF of the robot, which is changed in place.", show_default=False
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write instead; the robot's file is not changed.", show_default=False
        ),
    ] = None,
    xacro_yaml: Annotated[
        Path | None,
        typer.Option(
            help="YAML file to write with all inertials, for `xacro.load_yaml`.",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing files of --out, --xacro-yaml.")
    ] = False,
) -> None:
    """Write the identified numbers into your URDF or MJCF, and change nothing else in it.

    The earlier file is kept as FILE.orig. Links and joints must be those of the result. The written
    file is read again and compared.
    """
    from symbid_ros.atomic_write import check_output_file, require_distinct, write_text
    from symbid_ros.estimation.estimate_file import load_estimate
    from symbid_ros.identification.installation import inertials_yaml, install

    if robot is None and xacro_yaml is None:
        raise EstimateError(
            "there is nothing to write; name the robot's file, or give --xacro-yaml FILE", "E577"
        )
    if robot is None and out is not None:
        raise EstimateError("--out needs the robot's file to start from; name it", "E577")
    if robot is not None and robot.suffix == ".xacro":
        raise EstimateError(
            f"{robot}: is xacro, whose macros compute the numbers; give --xacro-yaml FILE instead "
            "and read it with xacro.load_yaml",
            "E577",
        )
    require_distinct({"the robot's file": robot, "`out`": out, "`xacro_yaml`": xacro_yaml})
    for path in filter(None, (out, xacro_yaml)):
        check_output_file(path, lambda _: overwrite, "give `overwrite`")
    console = Console(soft_wrap=True, highlight=False)
    verdict = load_estimate(result / "estimate.json").verdict
    for alarm in () if verdict is None else verdict.alarms:
        console.print(Text(f"alarm of the identification: {alarm}", style="bold red"))
    if robot is not None:
        done = install(result, robot, out)
        for backup in done.backups:
            console.print(Text(f"kept {backup}"))
        for file in done.files:
            console.print(Text(f"wrote {file}"))
        if not done.files:
            console.print(Text(f"{out or robot}: holds these parameters already"))
    if xacro_yaml is not None:
        write_text(xacro_yaml, inertials_yaml(result))
        console.print(Text(f"wrote {xacro_yaml}"))


def print_change(found: "RobotChange") -> None:
    """Print one line for each number, so that the table fits narrow terminals."""
    console = Console(highlight=False)
    table = Table(
        title=f"{found.model}, {found.method}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("", overflow="fold")
    for header in ("before", "after", "±"):
        table.add_column(header, justify="right", no_wrap=True)
    moments = [link.principal_inertia_kg_m2 for link in found.links]
    largest = max(abs(value) for one in moments for value in (*one.before, *one.after))
    scale, unit = (1.0, "kg m²") if largest >= 10 else (1e3, "g m²")
    for link in found.links:
        table.add_row(Text(link.name, style="bold cyan"))
        _add_rows(table, ("mass kg",), link.mass_kg)
        _add_rows(table, [f"CoM {axis} mm" for axis in "xyz"], link.com_m, 1e3)
        inertia = link.principal_inertia_kg_m2
        _add_rows(table, [f"I{number} {unit}" for number in "123"], inertia, scale)
        if link.determined is not None:
            table.add_row("  determined", "", f"{link.determined} of 10", "")
        table.add_section()
    for term in found.joint_terms:
        std = None if term.std is None else (term.std,)
        change = _single(term.before, term.after, std)
        unit = term.unit.replace("^2", "²")
        _add_rows(table, (f"{term.name} {unit}",), change)
    console.print(table)
    console.print(
        "I1, I2, I3: principal moments about the centre of mass; *: changed by more than twice ±",
        soft_wrap=True,
    )


def _single(before: float, after: float, std: tuple[float, ...] | None) -> "Change":
    from symbid_ros.identification.link_changes import Change

    return Change((before,), (after,), std)


def _add_rows(
    table: Table, names: "tuple[str, ...] | list[str]", change: "Change", scale: float = 1.0
) -> None:
    """Add a row for each component, with the digits that its deviation allows."""
    stds = change.std or (None,) * len(names)
    for name, before, after, std in zip(names, change.before, change.after, stds, strict=True):
        is_large = std is not None and abs(after - before) > 2 * std
        decimals = _decimals(scale * before, scale * after, None if std is None else scale * std)
        numbers = [f"{scale * value:.{decimals}f}" if value else "0" for value in (before, after)]
        deviation = "–" if std is None else f"{scale * std:.{decimals}f}"
        after_cell = Text(f"*{numbers[1]}", "bold") if is_large else Text(numbers[1])
        table.add_row(Text(f"  {name}"), numbers[0], after_cell, deviation)


def _decimals(before: float, after: float, std: float | None) -> int:
    """Return the decimals for two digits of the deviation, or four of the largest value."""
    from math import floor, log10

    if std is not None and std > 0:
        return min(max(1 - floor(log10(std)), 0), 9)
    largest = max(abs(before), abs(after))
    return 3 if largest == 0 else min(max(3 - floor(log10(largest)), 0), 9)
