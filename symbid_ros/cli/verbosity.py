"""The flags ``-v`` and ``-q`` of every command, and its progress bar."""

import inspect
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from time import monotonic
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from symbid_ros.package_paths import PACKAGE
from symbid_ros.progress import reported_to

logger = logging.getLogger(__name__)

PANEL = "Messages"
Verbose = Annotated[
    int,
    typer.Option(
        "-v",
        "--verbose",
        count=True,
        help="Print steps and their durations; -vv prints more.",
        rich_help_panel=PANEL,
        show_default=False,
        metavar="",
    ),
]
Quiet = Annotated[
    bool,
    typer.Option("-q", "--quiet", help="Print no warnings and no progress.", rich_help_panel=PANEL),
]


def with_verbosity(function: Callable[..., None]) -> Callable[..., None]:
    """Add the flags ``--verbose`` and ``--quiet`` to a command."""
    shown = list(inspect.signature(function).parameters.values())
    for name, kind, default in (("verbose", Verbose, 0), ("quiet", Quiet, False)):
        shown.append(
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind
            )
        )

    @wraps(function)
    def command(*arguments: Any, verbose: int, quiet: bool, **values: Any) -> None:
        with logged_level(-1 if quiet else verbose):
            function(*arguments, **values)

    command.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in shown}
    return command


@contextmanager
def logged_level(verbosity: int) -> Iterator[None]:
    """Let the package log errors (-1), warnings (0), steps (1) or everything (2).

    A command may load a model several times; each warning about it is logged once.
    """
    levels = {-1: logging.ERROR, 0: logging.WARNING, 1: logging.INFO}
    package = logging.getLogger(PACKAGE)
    before = package.level
    package.setLevel(levels.get(verbosity, logging.DEBUG))
    models = logging.getLogger(f"{PACKAGE}.model.load")
    logged: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        is_first = message not in logged
        logged.add(message)
        return is_first

    models.addFilter(is_new)
    try:
        yield
    finally:
        models.removeFilter(is_new)
        package.setLevel(before)


def shows_progress(console: Console) -> bool:
    """Return whether a progress bar belongs on a console: on a terminal, unless told not to."""
    return console.is_terminal and logging.getLogger(PACKAGE).level <= logging.WARNING


def progress_columns() -> tuple[ProgressColumn, ...]:
    """Return the parts of a progress bar: step, bar, share, time taken and time left."""
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )


@contextmanager
def progress_shown() -> Iterator[None]:
    """Show the steps that the code reports as a bar on a terminal, and log how long each took."""
    # The errors' stream, so that the output can be piped.
    console = Console(stderr=True)
    with Progress(
        *progress_columns(),
        console=console,
        transient=True,
        disable=not shows_progress(console),
        redirect_stdout=False,
    ) as bars:
        steps = _Steps(bars)
        try:
            with reported_to(steps.update):
                yield
        finally:
            steps.finish()


class _Steps:
    """The step that runs, as a bar; the bar of the one before it is removed."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._bar: TaskID | None = None
        self._step, self._share, self._start = "", 0.0, 0.0

    def update(self, step: str, share: float | None) -> None:
        # A step that begins again, such as another pass over the log, gets a new bar.
        again = share is not None and share < self._share
        if step != self._step or again:
            self.finish()
            self._step, self._start = step, monotonic()
            self._bar = self._bars.add_task(step, total=None if share is None else 1.0)
        if self._bar is not None and share is not None:
            self._share = share
            self._bars.update(self._bar, completed=share)

    def finish(self) -> None:
        """Remove the bar of the last step and log how long it took."""
        if self._bar is not None:
            self._bars.remove_task(self._bar)
            logger.info("%s: %.1f s", self._step, monotonic() - self._start)
        self._bar, self._step, self._share = None, "", 0.0
