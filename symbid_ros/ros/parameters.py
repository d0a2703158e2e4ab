"""Node parameters with description, type and range, which are checked before they take effect."""

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
        Default value. It also sets the type and, for a list of numbers, the length. A parameter
        with a list of texts also accepts a single text.
    kind : type or None
        Type of the values; that of the default if None.
    length : int
        Length of a list of numbers that has no default; 0 for other values.
    minimum, maximum : float or None
        Inclusive range of a number, or of each number in a list. None stands for ±10⁹, or
        ±(2³¹ - 1) for integers; NaN and infinity are always out of range.
    choices : tuple of str
        Allowed values of a text; empty: any.
    live : bool
        Whether it can be set while the node runs.
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
        """Return the descriptor that ``ros2 param describe`` shows."""
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
        """Raise a ParameterError for what a descriptor cannot express.

        It covers choices, types, and the length and numbers of lists.
        """
        if value is None and self.default is None:
            return
        is_valid = not self.choices or value in self.choices
        if self.default is None:
            is_valid = is_valid and self.is_of_kind(value)
        elif self._is_texts:
            is_valid = all(isinstance(each, str) for each in self.plain(value))
        elif self._is_vector:
            low, high = self._bounds()
            value = list(value)
            # NaN fails this comparison.
            is_valid = len(value) == len(self.default) and all(low <= one <= high for one in value)
        if not is_valid:
            raise ParameterError(
                f"parameter {self.name}: {value!r} is not valid; give {self.expected}", "E801"
            )

    @property
    def expected(self) -> str:
        """Description of the valid values."""
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
        """Return a value in Python's types; rclpy returns an array.array for a list."""
        if not isinstance(value, bool | int | float | str | None):
            return list(value)
        return [value] if self._is_texts else value

    @property
    def _type(self) -> type:
        return self.kind or type(self.default)

    def is_of_kind(self, value: Any) -> bool:
        """Return whether a value is a number of the right type; integers also count as floats."""
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


def options_from(kind: type[T], values: Values) -> T:
    """Return the options that the values of generated parameters define.

    Raises
    ------
    ParameterError
        When an option is invalid, or two contradict each other; it names parameters.
    """
    given: dict[str, Any] = {}
    for option in options_of(kind):
        value = values[option.name]
        if option.is_sequence:  # ROS has no typed empty list: [""] stands for it
            value = tuple(one for one in value if one)
        given[option.name] = None if value == "" and option.is_optional else value
    try:
        return kind(**given)
    except OptionError as error:
        message = spelled(str(error), lambda name: name)
        # Most messages begin with the name of the option.
        prefix = "parameter" if str(error).startswith("`") else "parameters:"
        raise ParameterError(f"{prefix} {message}", error.code) from None


def _parameter(option: Option) -> Parameter:
    default, kind = option.default, option.kind
    description = spelled(option.help, lambda name: name)
    if option.unit:
        description = f"{description} Unit: {option.unit}."
    if option.unset:
        description = f"{description} Default: {spelled(option.unset, lambda name: name)}."
    choices = option.choices
    if option.length and default is not None:
        default = list(default)
    elif option.is_sequence:
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
        live=option.live,
        kind=kind if default is None else None,
        length=option.length if default is None else 0,
    )


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare parameters and return their values by name, or raise a ParameterError.

    Live parameters cannot be set before they are watched.
    """
    # rclpy declares this parameter in every node without a description.
    clock = ParameterDescriptor(
        type=ParameterType.PARAMETER_BOOL,
        description="Use the time on /clock instead of the system time.",
    )
    node.set_descriptor("use_sim_time", clock)
    values = {parameter.name: _declare_one(node, parameter) for parameter in parameters}
    if any(parameter.live for parameter in parameters):
        node.add_on_set_parameters_callback(_refuse_change)
    return values


def watch(
    node: Node,
    parameters: Sequence[Parameter],
    on_change: Callable[[dict[str, Any]], None],
    check: Callable[[dict[str, Any]], object] = lambda values: None,
) -> None:
    """Allow declared live parameters to be set while the node runs.

    Both callables get the new values of all live parameters by name. They run in the thread that
    executes the node's services.

    Parameters
    ----------
    node : Node
    parameters : sequence of Parameter
    on_change : callable
        Called after values have changed.
    check : callable, optional
        Raises SymbidError for invalid values; the message is the reason of the refusal. It must
        have no effect, because another parameter of the same request may still be refused.
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

    node.remove_on_set_parameters_callback(_refuse_change)
    node.add_on_set_parameters_callback(accept)
    node.add_post_set_parameters_callback(follow)


def _refuse_change(given: Sequence[Any]) -> SetParametersResult:
    if all(entry.name == "use_sim_time" for entry in given):
        return SetParametersResult(successful=True)
    return SetParametersResult(
        successful=False,
        reason="cannot be set: the node is still starting, or its mode does not use the parameter",
    )


def _declare_one(node: Node, parameter: Parameter) -> Any:
    try:
        declared = node.declare_parameter(
            parameter.name, parameter.default, parameter.descriptor()
        ).value
    except ParameterException as error:
        raise ParameterError(
            f"parameter {parameter.name}: not a valid value; give {parameter.expected}", "E801"
        ) from error
    value = parameter.plain(declared)
    parameter.require(value)
    return value
