"""The flag ``--dask`` of commands that workers of a Dask cluster can help with."""

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from symbid_ros.cli.verbosity import shows_progress

Dask = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a Dask scheduler, whose workers do the work, such as tcp://10.0.0.5:8786.",
        show_default=False,
    ),
]


def print_dashboard(link: str) -> None:
    """Print the link of the page on which Dask shows its tasks, on a terminal."""
    console = Console(stderr=True)
    if shows_progress(console):
        console.print(f"Dask dashboard: {link}", highlight=False)


def bag_location(bag: Path) -> str:
    """Return the URL or the absolute path of a bag that a command was given."""
    text = str(bag)
    # A path has one slash where a URL has two.
    if scheme := re.match(r"([a-z][a-z0-9+.-]+):/+", text):
        return (
            text[len("file:") :] if scheme[1] == "file" else f"{scheme[1]}://{text[scheme.end() :]}"
        )
    return str(bag.absolute())
