"""Node parameters: declared with description and range, checked before anything changes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from symbid_ros.errors import OptionError, SymbidError
from symbid_ros.options import Option, options_of, spelled

LARGE_INTEGER = 2**31 - 1
LARGE_NUMBER = 1e9

Values = Mapping[str, Any]
T = TypeVar("T")


class ParameterError(SymbidError):
    """A node parameter of the wrong type or outside its range."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Attributes
    ----------
    name, description : str
    default : bool, int, float, str, list of str, list of float or None
        Also fixes the type; a list of numbers its length as well. Where it is a list of texts, a
        single text may be given in place of a list of one.
    kind : type or None
        Type of the values; that of the default if None.
    length : int
        Length of a list of numbers that has no default; 0 for other values.
    minimum, maximum : float or None
        Inclusive range of a number, or of each of a list; None for ±10⁹ (numbers) or
        ±(2³¹ - 1) (integers): NaN and infinity lie outside any.
    choices : tuple of str
        What a string may be; anything when empty.
    live : bool
        Whether it may be set while the node runs.
    """

    name: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    kind: type | None = None
    length: int = 0

    def descriptor(self) -> ParameterDescriptor:
        """Return what ``ros2 param describe`` shows."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=self.description,
            additional_constraints=self._constraints(),
            read_only=not self.live,
            dynamic_typing=self._is_texts or self.default is None,
        )
        low, high = self._bounds()
        if self.default is None:  # a value that once meant "not given" may lie outside the range
            return descriptor
        if self._type is int:
            descriptor.integer_range = [
                IntegerRange(from_value=int(low), to_value=int(high), step=1)
            ]
        elif self._type is float or self._is_vector:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
        return descriptor

    def require(self, value: Any) -> None:
        """Refuse a value of the right type for what a descriptor cannot say.

        Raises
        ------
        ParameterError
            When it is none of the choices, or a list of the wrong length or with numbers out of
            range.
        """
        if value is None and self.default is None:
            return
        if self.default is None and not self.is_of_kind(value):
            raise ParameterError(
                f"parameter {self.name}: {value!r} is not valid; give {self.expected}"
            )
        if self._is_texts and not all(isinstance(each, str) for each in self.plain(value)):
            raise ParameterError(
                f"parameter {self.name}: {value!r} is not valid; give {self.expected}"
            )
        if self.choices and value not in self.choices:
            raise ParameterError(
                f"parameter {self.name}: {value!r} is not known; give {self.expected}"
            )
        if self._is_vector:
            low, high = self._bounds()
            # Written so that NaN is refused.
            if len(value) != len(self.default) or not all(low <= each <= high for each in value):
                raise ParameterError(
                    f"parameter {self.name}: {list(value)} is no valid value; give {self.expected}"
                )

    @property
    def expected(self) -> str:
        """What may be given, in words."""
        if self.choices:
            return f"one of {', '.join(filter(None, self.choices))}"
        kinds = {bool: "true or false", int: "an integer", float: "a number with a decimal point"}
        kind = kinds.get(self._type, "text")
        if self.length:
            kind = f"a list of {self.length} numbers"
        elif self._is_vector:
            kind = f"a list of {len(self.default)} numbers with decimal points"
        elif isinstance(self.default, list):
            kind = "a text or a list of texts"
        bounds = [
            f"{word} {bound:g}"
            for word, bound in (("at least", self.minimum), ("at most", self.maximum))
            if bound is not None
        ]
        return " ".join([kind, " and ".join(bounds)]).strip()

    def plain(self, value: Any) -> Any:
        """Return a value in Python's types: rclpy gives an array.array for a list."""
        if not isinstance(value, bool | int | float | str | None):
            return list(value)
        return [value] if self._is_texts else value

    @property
    def _type(self) -> type:
        return self.kind or type(self.default)

    def is_of_kind(self, value: Any) -> bool:
        """Tell whether a value is a number of the right type; whole numbers are of both."""
        if self.length:
            single = replace(self, length=0)
            values = value if isinstance(value, list) else []
            return len(values) == self.length and all(map(single.is_of_kind, values))
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and (self._type is float or value == int(value))

    @property
    def _is_vector(self) -> bool:
        return isinstance(self.default, list) and isinstance(self.default[0], float)

    @property
    def _is_texts(self) -> bool:
        return isinstance(self.default, list) and not self._is_vector

    def _bounds(self) -> tuple[float, float]:
        largest = LARGE_INTEGER if self._type is int else LARGE_NUMBER
        return (
            -largest if self.minimum is None else self.minimum,
            largest if self.maximum is None else self.maximum,
        )

    def _constraints(self) -> str:
        if self.default is None:
            return f"{self.expected}, or not set"
        return self.expected if self.choices or self._is_vector else ""


def parameters_of(kind: type) -> tuple[Parameter, ...]:
    """Return a parameter for each option of a dataclass of options."""
    return tuple(_parameter(option) for option in options_of(kind))


def require_spelled(make: Callable[[], T]) -> T:
    """Return what a function makes of options; its errors name parameters instead.

    Raises
    ------
    ParameterError
        When an option is invalid.
    """
    try:
        return make()
    except OptionError as error:
        message = spelled(str(error), lambda name: name)
        # Most messages begin with the name of the option.
        prefix = "parameter" if str(error).startswith("`") else "parameters:"
        raise ParameterError(f"{prefix} {message}", error.code) from None


def options_from(kind: type[T], values: Values) -> T:
    """Return the options that parameters generated by :func:`parameters_of` have as values.

    Raises
    ------
    ParameterError
        When an option is invalid, or two contradict each other.
    """
    given: dict[str, Any] = {}
    for option in options_of(kind):
        value = values[option.name]
        if option.is_sequence:  # ROS has no typed empty list: [""] stands for it
            value = tuple(one for one in value if one)
        given[option.name] = None if value == "" and option.is_optional else value
    return require_spelled(lambda: kind(**given))


def _parameter(option: Option) -> Parameter:
    default, kind = option.default, option.kind
    description = spelled(option.help, lambda name: name)
    if option.unit:
        description = f"{description} Unit: {option.unit}."
    if option.unset:
        description = f"{description} Default: {spelled(option.unset, lambda name: name)}."
    choices = option.choices
    if option.is_sequence:
        default = [str(one) for one in default] or [""]
    elif kind in (str, Path) and default is None:
        default = ""
        choices = ("", *choices) if choices else ()
    return Parameter(
        option.name,
        default,
        description,
        option.minimum,
        option.maximum,
        choices,
        kind=kind if default is None else None,
        length=option.length,
    )


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare parameters and return their values by name.

    Live ones are refused to whoever sets them until they are watched.

    Raises
    ------
    ParameterError
        When one was given a value that it cannot take.
    """
    # rclpy declares it in every node, and leaves it undescribed.
    clock = ParameterDescriptor(
        type=ParameterType.PARAMETER_BOOL,
        description="Take the time from /clock, not from the system.",
    )
    node.set_descriptor("use_sim_time", clock)
    values = {parameter.name: _declared(node, parameter) for parameter in parameters}
    if any(parameter.live for parameter in parameters):
        node.add_on_set_parameters_callback(_not_yet)
    return values


def watch(
    node: Node,
    parameters: Sequence[Parameter],
    on_change: Callable[[dict[str, Any]], None],
    check: Callable[[dict[str, Any]], None] = lambda values: None,
) -> None:
    """Let the live ones among declared parameters be set while the node runs.

    Both callables get all live values by name as they are after the set, and run in the thread
    that executes the node's services.

    Parameters
    ----------
    node : Node
        On which they are declared.
    parameters : sequence of Parameter
        The live ones are watched.
    on_change : callable
        Told of values that were accepted and differ from those before.
    check : callable, optional
        Raises SymbidError, whose message the setter is told, when values do not do; it must
        change nothing, as another parameter of the same set may still be refused.
    """
    live = {parameter.name: parameter for parameter in parameters if parameter.live}
    current = {name: one.plain(node.get_parameter(name).value) for name, one in live.items()}

    def changed(given: Sequence[Any]) -> dict[str, Any]:
        return {
            entry.name: live[entry.name].plain(entry.value) for entry in given if entry.name in live
        }

    def accept(given: Sequence[Any]) -> SetParametersResult:
        values = changed(given)
        try:
            for name, value in values.items():
                live[name].require(value)
            if values:
                check(current | values)
        except SymbidError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def follow(given: Sequence[Any]) -> None:
        before = dict(current)
        current.update(changed(given))
        if current != before:
            on_change(dict(current))

    node.remove_on_set_parameters_callback(_not_yet)
    node.add_on_set_parameters_callback(accept)
    node.add_post_set_parameters_callback(follow)


def _not_yet(given: Sequence[Any]) -> SetParametersResult:
    if all(entry.name == "use_sim_time" for entry in given):
        return SetParametersResult(successful=True)
    return SetParametersResult(
        successful=False,
        reason="not followed now: the node is still starting, or its mode has no use for it",
    )


def _declared(node: Node, parameter: Parameter) -> Any:
    try:
        declared = node.declare_parameter(
            parameter.name, parameter.default, parameter.descriptor()
        ).value
    except ParameterException as error:
        raise ParameterError(
            f"parameter {parameter.name}: not a valid value; give {parameter.expected}"
        ) from error
    value = parameter.plain(declared)
    parameter.require(value)
    return value
