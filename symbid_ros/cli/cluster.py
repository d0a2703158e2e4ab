"""The flag ``--dask`` of commands that workers of a Dask cluster can help with."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from symbid_ros.cli.verbosity import shows_progress
from symbid_ros.errors import OptionError

Dask = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tcp://10.0.0.5:8786; its workers run the tasks.",
        show_default=False,
    ),
]


def print_dashboard(link: str) -> None:
    """Print the link of the page on which Dask shows its tasks, on a terminal."""
    console = Console(stderr=True)
    if shows_progress(console):
        console.print(f"Dask dashboard: {link}", highlight=False)


# A path has one slash where a URL has two.
URL = re.compile(r"([a-z][a-z0-9+.-]+):/+")


def require_no_urls(bags: Sequence[Path]) -> None:
    """Refuse bags at URLs, which only the workers of a cluster open."""
    for bag in bags:
        if URL.match(str(bag)) and not bag.exists():
            raise OptionError(
                f"{bag}: bags at URLs need `dask`, whose workers open them; give the path of a "
                "folder, or `dask`",
                "E501",
            )


def bag_location(bag: Path) -> str:
    """Return the URL or the absolute path of a bag that a command was given."""
    text = str(bag)
    if scheme := URL.match(text):
        return (
            text[len("file:") :] if scheme[1] == "file" else f"{scheme[1]}://{text[scheme.end() :]}"
        )
    return str(bag.absolute())
