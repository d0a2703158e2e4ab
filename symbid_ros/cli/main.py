"""The ``symbid`` command: one line for every error, exit status 2."""

import logging
import os
import sys
from typing import Annotated, NoReturn

import typer
import typer.exceptions
from rich.console import Console
from rich.logging import RichHandler

from symbid_ros.cli.bag import app as bag
from symbid_ros.cli.demo import demo
from symbid_ros.cli.evaluate import evaluate
from symbid_ros.cli.identify import identify
from symbid_ros.cli.prior import prior
from symbid_ros.cli.report import report
from symbid_ros.cli.simulate import simulate
from symbid_ros.cli.study import study
from symbid_ros.cli.udp_client import udp_client
from symbid_ros.errors import SymbidError
from symbid_ros.share import package_version

app = typer.Typer(
    help="Identify the inertial and friction parameters of a robot from ROS 2 bags.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
_ALL = demo, simulate, prior, identify, evaluate, report, study, udp_client
INTERRUPTED = 130  # as shells have it: 128 and the signal's number

for command in _ALL:
    app.command(command.__name__.replace("_", "-"))(command)
app.add_typer(bag, name="bag")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"symbid_ros {package_version()}")
        raise typer.Exit


@app.callback()
def _symbid(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    # Every job here is one stream of small matrices, on which BLAS threads only get in
    # each other's way (and in the way of whatever else the robot's computer does); with their
    # number the last digits would change. Read when NumPy and SciPy are loaded, which is later.
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"


def main() -> None:
    """Run the command line; errors of ours are one line on stderr and status 2."""
    console = Console(stderr=True, soft_wrap=True)
    handler = RichHandler(console=console, show_time=False, show_path=False, markup=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    try:
        # By itself click would name whatever module runs this.
        status = app(prog_name="symbid", standalone_mode=False)
    except SymbidError as error:
        _fail(console, str(error))
    except typer.exceptions.TyperException as error:
        if not error.format_message():  # no arguments at all, answered by the help
            sys.exit(2)
        command = getattr(getattr(error, "ctx", None), "command_path", "symbid")
        _fail(console, f"{error.format_message().rstrip('.')}; see `{command} --help`")
    except KeyboardInterrupt:
        status = INTERRUPTED
    if status == INTERRUPTED:
        console.print("symbid: interrupted", markup=False)
    sys.exit(status)


def _fail(console: Console, message: str) -> NoReturn:
    text = " ".join(message.split())
    console.print(f"symbid: {text}", style="red", markup=False, highlight=False)
    sys.exit(2)


if __name__ == "__main__":
    main()
