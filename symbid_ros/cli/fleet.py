"""``symbid fleet``."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.box import HEAVY_HEAD
from rich.console import Console
from rich.text import Text

from symbid_ros.cli.fitted_tables import print_table
from symbid_ros.cli.verbosity import progress_shown


def fleet(
    results: Annotated[
        list[Path],
        typer.Argument(help="Folders of identifications, one for each robot.", show_default=False),
    ],
    out: Annotated[
        Path | None, typer.Option(help="HTML file to write.", show_default=False)
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of tables.")
    ] = False,
) -> None:
    """Compare robots of one type: common parameters, and robots and links that differ.

    All must be identified with the same model. Joint terms are chosen for all together.

    Exit status: 0 no robot differs, 1 at least one does, 2 error.
    """
    from symbid_ros.atomic_write import check_output_file, write_text
    from symbid_ros.identification.fleet import fleet_document, fleet_of_results, spread_sizes
    from symbid_ros.report.fleet_page import COLUMNS, LEGEND, fleet_rows, render_fleet
    from symbid_ros.report.templates import is_page

    if out is not None:
        check_output_file(out, is_page)
    with progress_shown():
        found = fleet_of_results(results)
    if out is not None:
        write_text(out, render_fleet(found))
    document = fleet_document(found)
    if as_json:
        typer.echo(json.dumps(document, indent=1))
    else:
        console = Console(highlight=False)
        rows = [(name, cells) for name, *cells in fleet_rows(found)]
        groups = COLUMNS, found.robots
        print_table(console, "link", groups, rows, style=HEAVY_HEAD)
        console.print(Text(LEGEND), soft_wrap=True)
        spread = ", ".join(f"{name} {size} %" for name, size in spread_sizes(found).items())
        console.print(Text(f"between robots: {spread}"), soft_wrap=True)
        style = "bold red" if found.deviations else "green"
        console.print(Text(str(document["verdict"]), style=style), soft_wrap=True)
        if out is not None:
            console.print(Text(f"wrote {out}"), soft_wrap=True)
    if found.deviations:
        raise typer.Exit(1)
