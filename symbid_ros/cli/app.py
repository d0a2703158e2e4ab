"""The command ``symbid``: its subcommands, and errors as one line with exit status 2."""

import inspect
import io
import logging
import os
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any, TextIO, get_args

import typer
import typer.exceptions
import typer.main
from rich.console import Console
from rich.logging import RichHandler
from rich.text import Text

from symbid_ros.cli.bag import app as bag
from symbid_ros.cli.demo import demo
from symbid_ros.cli.estimates import evaluate, identify, prior, report
from symbid_ros.cli.excite import excite
from symbid_ros.cli.flags import TYPES, flag
from symbid_ros.cli.fleet import fleet
from symbid_ros.cli.init import init
from symbid_ros.cli.install import apply, diff
from symbid_ros.cli.live import live
from symbid_ros.cli.simulate import simulate, udp_client
from symbid_ros.cli.study import study
from symbid_ros.cli.validate import compare, validate
from symbid_ros.cli.verbosity import with_verbosity
from symbid_ros.errors import SymbidError
from symbid_ros.options import spelled
from symbid_ros.package_paths import package_version

app = typer.Typer(
    help="Identify the inertial and friction parameters of a robot from ROS 2 bags.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
NARROW = 80  # columns of a terminal, below which names of options do not fit in frames
# Columns for each character of the longest name, which frames would cut off on a narrower terminal.
COLUMNS_PER_CHARACTER = 3.8
USAGE = 2  # status after an error that the user can correct
CLOSED_PIPE = 141  # as in shells: 128 plus the number of SIGPIPE

COMMANDS = (
    demo,
    simulate,
    excite,
    prior,
    init,
    identify,
    live,
    validate,
    compare,
    fleet,
    diff,
    apply,
    evaluate,
    report,
    study,
    udp_client,
)

for command in COMMANDS:
    app.command(command.__name__.replace("_", "-"))(with_verbosity(command))
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
    # The matrices are small, so several BLAS threads would slow down each other and other programs
    # on the robot's computer, and the last digits of results would depend on their number. The
    # variables take effect because NumPy and SciPy are imported later.
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    # No command renders. MuJoCo would otherwise load GLFW, which starts a process for it that
    # prints a traceback after Ctrl-C.
    os.environ.setdefault("MUJOCO_GL", "disable")


def run() -> int:
    """Run the command line and return its exit status; print an error as one line."""
    console = Console(stderr=True, soft_wrap=True)
    handler: logging.Handler
    if console.is_terminal:
        handler = RichHandler(console=console, show_time=False, show_path=False, markup=False)
        handler.setFormatter(_Formatter("%(message)s"))
    else:  # Rich would break the lines.
        handler = logging.StreamHandler()
        handler.setFormatter(_Formatter("%(levelname)-8s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    try:
        # Without prog_name, click would use the name of the calling module.
        with redirect_stdout(_output()):
            return _command()(prog_name="symbid", standalone_mode=False) or 0
    except SymbidError as error:
        message = spelled(error.labelled, flag)
    except SystemExit as ended:
        # So click and Rich end when the reader of a pipe has closed it; commands return their 1.
        if ended.code != 1:
            raise
        return CLOSED_PIPE
    except OSError as error:
        # The operating system rejects a path, such as a name that is too long.
        if error.filename is None:
            raise
        message = f"{os.fsdecode(error.filename)}: {error.strerror}; check the path"
    except typer.exceptions.TyperException as error:
        if not error.format_message():  # no arguments: the help has been printed
            return USAGE
        hint = _command_of_group() or f"see `{_named_command()} --help`"
        message = f"{_plain(error.format_message()).rstrip('.')}; {hint}"
    text = " ".join(message.split())
    console.print(f"symbid: {text}", style="red", markup=False, highlight=False)
    return USAGE


class _Output(io.FileIO):
    """Standard output, whose failures are errors that a user can fix, such as a full disk."""

    def write(self, data: Any) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except BrokenPipeError:  # the libraries end the command
            raise
        except OSError as error:
            # Python would try to write the rest at the end of the process.
            with open(os.devnull, "wb") as null:
                os.dup2(null.fileno(), self.fileno())
            raise SymbidError(
                f"standard output: cannot write ({error.strerror}); choose another place", "E552"
            ) from None


def _output() -> TextIO | None:
    """Return the stream for standard output; None if that is closed."""
    found = sys.__stdout__
    if found is None or found is not sys.stdout:  # closed, or the stream of a caller
        return sys.stdout
    binary = io.BufferedWriter(_Output(found.fileno(), "wb", closefd=False))
    return io.TextIOWrapper(
        binary, found.encoding, found.errors, line_buffering=found.line_buffering
    )


def _plain(message: str) -> str:
    """Return a message about a value without the terms of the library that validates it."""
    unparsed = r"Input should be a valid (\w+), unable to parse string as an? \w+"
    message = re.sub(unparsed, r"it is not a valid \1", message)
    return message.replace("Value error, ", "").replace("Input should", "it should")


def _named_command() -> str:
    """Return the command and subcommands that the user named."""
    command: Any = typer.main.get_command(app)
    names = ["symbid"]
    for word in sys.argv[1:]:
        command = getattr(command, "commands", {}).get(word)
        if command is None:
            break
        names.append(word)
    return " ".join(names)


def _command_of_group() -> str:
    """Return the command of a group that the user named without the group; empty if none."""
    word = next(iter(sys.argv[1:]), "")
    commands: dict[str, Any] = getattr(typer.main.get_command(app), "commands", {})
    for name, group in commands.items():
        if word not in commands and word in getattr(group, "commands", {}):
            return f"give `symbid {name} {word}`"
    return ""


class _Formatter(logging.Formatter):
    """Spells options in messages as flags."""

    def format(self, record: logging.LogRecord) -> str:
        return spelled(super().format(record), flag)


def _command() -> Any:
    """Return the click command that typer builds, with all subcommands."""
    command = typer.main.get_command(app)
    _name_types(command)
    _refuse_empty_paths(command)
    _join_lines_of_help(command)
    _print_plain_help(command, get_terminal_size().columns)
    return command


def _print_plain_help(command: Any, columns: int) -> None:
    """Print help without frames where their columns would cut off the names of options."""
    subcommands = getattr(command, "commands", {}).values()
    for subcommand in subcommands:
        _print_plain_help(subcommand, columns)
    longest = max((len(name) for one in command.params for name in one.opts), default=0)
    if not subcommands and columns < max(NARROW, COLUMNS_PER_CHARACTER * longest):
        command.rich_markup_mode = None
        command.help = Text.from_markup(command.help).plain


def _join_lines_of_help(command: Any) -> None:
    """Let the terminal break the lines of each paragraph of help."""
    paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
    command.help = "\n\n".join(" ".join(each.split()) for each in paragraphs)
    for subcommand in getattr(command, "commands", {}).values():
        _join_lines_of_help(subcommand)


def _refuse_empty_paths(command: Any) -> None:
    """Refuse empty paths, such as unset variables, which pathlib reads as the current folder."""
    for parameter in command.params:
        parameter.process_value = partial(_nonempty, parameter, parameter.process_value)
    for subcommand in getattr(command, "commands", {}).values():
        _refuse_empty_paths(subcommand)


def _nonempty(parameter: Any, convert: Callable[..., Any], context: Any, value: Any) -> Any:
    """Return what a parameter makes of its value; raise BadParameter for an empty path."""
    converted = convert(context, value)
    given = value if isinstance(value, (list, tuple)) else [value]
    found = converted if isinstance(converted, (list, tuple)) else [converted]
    if any(one == "" and isinstance(path, Path) for one, path in zip(given, found, strict=False)):
        raise typer.BadParameter(
            "empty path; name a file or folder, perhaps a variable is not set",
            ctx=context,
            param=parameter,
        )
    return converted


def _name_types(command: Any, parent: Any = None) -> None:
    """Let help name the types of values alike in all commands, and none beside a flag."""
    # The context decides how help is asked for, which the command remembers.
    context = command.context_class(command, parent=parent, **command.context_settings)
    for parameter in command.get_params(context):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
        described = parameter.type_descriptor
        if not (described.is_choice or described.is_tuple):
            kind = next(iter(get_args(described.annotation)), described.annotation)
            if kind in TYPES:
                parameter.display_type = partial(_type_name, kind)
    for subcommand in getattr(command, "commands", {}).values():
        _name_types(subcommand, context)


def _type_name(kind: type, ctx: Any) -> str:
    return TYPES[kind]
