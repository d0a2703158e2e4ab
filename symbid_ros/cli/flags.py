"""Flags of commands, generated from dataclasses of options."""

import inspect
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from symbid_ros.choices import Base
from symbid_ros.errors import OptionError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import Option, options_of, spelled

Model = Annotated[Path, typer.Option(help="Robot model, URDF or MJCF.")]
# Of a command that also takes a robot file.
ModelOrRobot = Annotated[
    Path | None, typer.Option(help="Robot model, URDF or MJCF.", show_default=False)
]
Robot = Annotated[
    Path | None,
    typer.Option(
        help="Robot file (robot.yaml of `symbid init`), for options that are not given here.",
        show_default=False,
    ),
]
BaseKind = Annotated[
    Base,
    typer.Option(
        help="Base of a URDF; auto: floating, unless the root link is named 'world'. fixed also "
        "welds the base of an MJCF."
    ),
]
# Of commands that read a log together with the model.
LogBaseKind = Annotated[
    Base,
    typer.Option(
        help="Base of a URDF; auto: floating, unless the root link is named 'world', or an arm's "
        "log has neither an IMU nor a pose. fixed also welds the base of an MJCF."
    ),
]

# How help names the type of a value.
TYPES = {int: "<integer>", float: "<number>", Path: "<path>", str: "<text>"}
CONTEXT = "context"  # parameter in which typer passes how options were given


def flag(name: str) -> str:
    """Return how a command spells an option."""
    return f"--{name.replace('_', '-')}"


def with_flags(function: Callable[..., None], hidden: Collection[str] = ()) -> Callable[..., None]:
    """Replace each parameter that is a dataclass of options by one flag for each option.

    The function receives the dataclass with the values of the flags. If it has a parameter
    ``robot``, options that are not given have the values in that robot file. The help leaves out
    ``hidden`` options, which the function refuses with a reason.
    """
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, type] = {}
    shown: list[inspect.Parameter] = []
    for parameter in inspect.signature(function).parameters.values():
        hint = hints[parameter.name]
        options = options_of(hint) if hasattr(hint, "__dataclass_fields__") else ()
        if options:
            groups[parameter.name] = hint
            shown += [_parameter(one, hidden=one.name in hidden) for one in options]
        else:
            shown.append(parameter.replace(annotation=hint))
    # Keyword-only parameters may be in any order; others need those without a default first.
    shown = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in shown]

    takes_robot = "robot" in hints
    if takes_robot:
        shown.append(
            inspect.Parameter(CONTEXT, inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        )

    @wraps(function)
    def command(**values: Any) -> None:
        filled: list[str] = []
        if takes_robot:
            filled = _fill_from_robot_file(values, values.pop(CONTEXT))
        try:
            for name, kind in groups.items():
                given = {option.name: values.pop(option.name) for option in options_of(kind)}
                # None means that the flag was not given.
                options = kind(**{key: v for key, v in given.items() if v is not None})
                if isinstance(options, LogOptions):
                    options = replace(options, of_robot=tuple(filled))
                values[name] = options
            function(**values)
        except OptionError as error:
            if any(str(error).startswith(f"`{name}`") for name in filled):
                # In the file, options have their own names and not those of flags.
                message = f"{values['robot']}: {spelled(str(error), str)}"
                raise OptionError(message, error.code) from None
            raise

    command.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in shown}
    return command


def _fill_from_robot_file(values: dict[str, Any], context: typer.Context) -> list[str]:
    """Set the options that were not given to those of the robot file, and return their names."""
    file = values["robot"]
    if file is None:
        return []
    from symbid_ros.offline.robot_file import load_robot_file  # loads NumPy

    filled = []
    for name, value in load_robot_file(file).items():
        source = context.get_parameter_source(name)
        if name in values and (source is None or source.name == "DEFAULT"):
            values[name] = value
            filled.append(name)
    return filled


def require_model(model: Path | None, name: str = "`model`") -> Path:
    """Return the model that a command was given, directly or by its robot file.

    Parameters
    ----------
    model : Path or None
    name : str
        How the command spells it.

    Raises
    ------
    OptionError
        When there is none.
    """
    if model is None:
        raise OptionError(
            f"there is no model; give {name}, or a `robot` file that names it", "E501"
        )
    return model


def _parameter(option: Option, *, hidden: bool) -> inspect.Parameter:
    kind: Any = Literal[option.choices] if option.choices else option.kind
    if option.is_sequence:
        kind = list[kind]
    elif option.length:
        kind = tuple.__class_getitem__((kind,) * option.length)
    default = None if option.is_sequence else option.default
    if default is None:
        kind |= None
    metavar = None if option.choices else TYPES.get(option.kind)
    info = typer.Option(
        flag(option.name),
        help=_help(option),
        min=option.minimum,
        max=option.maximum,
        metavar=option.metavar or (f"<{option.unit}>" if option.unit else metavar),
        rich_help_panel=option.group or None,
        hidden=hidden,
        show_default=default not in (None, "") and default is not False,
    )
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, info],
    )


def _help(option: Option) -> str:
    words = [spelled(option.help, flag)]
    if option.positive:
        words.append("Above 0.")
    if option.is_sequence:
        words.append("Repeatable.")
    if option.unset:
        words.append(f"Default: {spelled(option.unset, flag)}.")
    return " ".join(words)
