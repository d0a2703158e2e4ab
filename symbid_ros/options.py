"""Definition of options as dataclass fields, with all that front ends show of them.

A command's flags, a node's parameters, parameter files, launch arguments and the reference page
are generated from these fields, so they cannot drift apart.
"""

import dataclasses
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from symbid_ros.errors import OptionError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
_KEY = "option"


def option(
    default: Any,
    help: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    positive: bool = False,
    group: str = "",
    metavar: str = "",
    unset: str = "",
    live: bool = False,
    accepts: Callable[[Any], bool] | None = None,
) -> Any:
    """Return a dataclass field that is an option.

    Parameters
    ----------
    default : object
        None if the option is not given by default.
    help : str
        One or two sentences; other options in backquotes.
    unit : str
        SI unit or ``%``.
    minimum, maximum : float, optional
        Inclusive range of a number.
    positive : bool
        Whether a number must be finite and above zero.
    group : str
        Heading under which a command lists it.
    metavar : str
        How a command's help shows the value.
    unset : str
        What applies if it is not given, for a default of None.
    live : bool
        Whether a node may change it while it runs.
    accepts : callable, optional
        Returns whether an object that only Python can give, such as a log, may take the place of a
        text or path.
    """
    notes = {
        "help": help,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "positive": positive,
        "group": group,
        "metavar": metavar,
        "unset": unset,
        "live": live,
        "accepts": accepts,
    }
    return field(default=default, metadata={_KEY: notes})


@dataclass(frozen=True)
class Option:
    """One option of a dataclass of options.

    Attributes
    ----------
    name : str
    kind : type
        bool, int, float, str or Path; for tuples, of the elements.
    default : object
        None if it is not given by default.
    choices : tuple of str
        Allowed values; any if empty.
    is_sequence : bool
        Whether any number of values may be given.
    length : int
        Number of values of a fixed-length tuple; 0 for other kinds.
    help, unit, group, metavar, unset, live, accepts, minimum, maximum, positive
        As in :func:`option`.
    """

    name: str
    kind: type
    default: Any
    choices: tuple[str, ...]
    is_sequence: bool
    length: int
    help: str
    unit: str
    minimum: float | None
    maximum: float | None
    positive: bool
    group: str
    metavar: str
    unset: str
    live: bool
    accepts: Callable[[Any], bool] | None

    @property
    def is_optional(self) -> bool:
        """Whether None (not given) is allowed."""
        return self.default is None

    def value_of(self, value: Any) -> Any:
        """Return a value converted to the option's type.

        Raises
        ------
        OptionError
            When the value has another type or lies outside the range.
        """
        if value is None and self.is_optional:
            return None
        if hasattr(value, "tolist"):  # an array or scalar of NumPy, which is not imported here
            value = value.tolist()
        if self.is_sequence or self.length:
            if isinstance(value, str | Path) or not isinstance(value, Sequence):
                value = (value,)
            if self.length and len(value) != self.length:
                raise self._error(value)
            return tuple(self._single(one) for one in value)
        return self._single(value)

    def _single(self, value: Any) -> Any:
        if self.choices and value not in self.choices:
            raise self._error(value)
        if self.kind in (str, Path) and not self.choices:
            allowed = str | Path if self.kind is Path else str
            if isinstance(value, allowed):
                return self.kind(value)
            if self.accepts is None or not self.accepts(value):
                raise self._error(value)
        if self.kind in (int, float):
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not is_number or (self.kind is int and not float(value).is_integer()):
                raise self._error(value)
            low = -math.inf if self.minimum is None else self.minimum
            high = math.inf if self.maximum is None else self.maximum
            is_usable = 0 < value < math.inf if self.positive else True
            if not (low <= value <= high and is_usable):  # refuses NaN
                raise self._error(value)
            return self.kind(value)
        if self.kind is bool and not isinstance(value, bool):
            raise self._error(value)
        return value

    def _error(self, value: Any) -> OptionError:
        return OptionError(f"`{self.name}`: {value!r} is not valid; give {self.expected}", "E501")

    @property
    def expected(self) -> str:
        """Description of the allowed values."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        names = {bool: "True or False", int: "an integer", float: "a number", Path: "a path"}
        words = names.get(self.kind, "text")
        if self.is_sequence:
            words = f"{words} or a list of {words.removeprefix('a ')}s"
        if self.length:
            words = f"{self.length} numbers"
        bounds = [
            f"{word} {bound:g}"
            for word, bound in (
                ("above", 0.0 if self.positive else None),
                ("at least", self.minimum),
                ("at most", self.maximum),
            )
            if bound is not None
        ]
        unit = f" ({self.unit})" if self.unit else ""
        return " ".join(filter(None, [words + unit, " and ".join(bounds)]))


def options_of(kind: type) -> tuple[Option, ...]:
    """Return the options that a dataclass defines, in order."""
    entries = [entry for entry in dataclasses.fields(kind) if _KEY in entry.metadata]
    # Hints of other dataclasses may name types that are imported for type checks only.
    hints = get_type_hints(kind) if entries else {}
    return tuple(
        _option(entry.name, hints[entry.name], entry.default, entry.metadata[_KEY])
        for entry in entries
    )


def check_values(options: Any) -> None:
    """Convert each field of a frozen dataclass of options to its type; call in __post_init__.

    Raises
    ------
    OptionError
        When a value has another type or lies outside its range.
    """
    for each in options_of(type(options)):
        object.__setattr__(options, each.name, each.value_of(getattr(options, each.name)))


def chosen_options(kind: type[T], options: T | None, fields: Mapping[str, Any]) -> T:
    """Return the options that a function got, as one object or as single fields of its kind.

    Raises
    ------
    OptionError
        When both are given, or an option has an unknown name or an invalid value.
    """
    if options is None:
        known = {each.name for each in dataclasses.fields(kind) if each.init}
        for name in fields:
            if name not in known:
                raise OptionError(
                    f"{name!r} is not an option; see symbid_ros.{kind.__name__}", "E501"
                )
        return kind(**fields)
    if fields:
        raise OptionError("give either options or single fields, not both", "E502")
    if not isinstance(options, kind):
        raise OptionError(
            f"options is a {type(options).__name__}; give a symbid_ros.{kind.__name__}, or its "
            "fields by name",
            "E501",
        )
    return options


def refuse_unused(options: Any, reason: str, names: Collection[str] | None = None) -> None:
    """Refuse options that have no effect, given why not.

    Parameters
    ----------
    options : dataclass of options
    reason : str
        Follows "has no effect", and says what to do.
    names : collection of str, optional
        Options without effect; by default all of them.

    Raises
    ------
    OptionError
        When one of them differs from its default.
    """
    for name in changed(options, names):
        raise OptionError(f"`{name}` has no effect {reason}", "E503")


def changed(options: Any, names: Collection[str] | None = None) -> dict[str, Any]:
    """Return the values of those options, of all by default, that differ from their defaults."""
    return {
        each.name: value
        for each in options_of(type(options))
        if (names is None or each.name in names)
        and (value := getattr(options, each.name)) != each.default
    }


def spelled(message: str, spelling: Callable[[str], str]) -> str:
    """Return a message in which the options, named in backquotes, are spelled for a front end."""
    return re.sub(r"`([a-z][a-z_]*)`", lambda found: spelling(found[1]), message)


def robot_file_line(name: str, *values: str | float) -> str:
    """Return the line of a robot file that gives an option these values, for error messages."""
    return f"{name}: {json.dumps(values)} in robot.yaml"


def _option(name: str, hint: Any, default: Any, notes: Mapping[str, Any]) -> Option:
    present = [one for one in _alternatives(hint) if one is not NoneType]
    hint = present[0]
    choices: tuple[str, ...] = ()
    is_sequence, length = False, 0
    if get_origin(hint) is tuple:
        arguments = get_args(hint)
        is_sequence = arguments[-1] is Ellipsis
        length = 0 if is_sequence else len(arguments)
        hint = next(one for one in _alternatives(arguments[0]))
    if get_origin(hint) is Literal:
        choices, hint = get_args(hint), str
    return Option(name, hint, default, choices, is_sequence, length, **notes)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
