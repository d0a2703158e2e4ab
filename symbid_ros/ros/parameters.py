"""Node parameters: declared with description and range, checked before anything starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from symbid_ros.errors import SymbidError

LARGE_INTEGER = 2**31 - 1
LARGE_NUMBER = 1e9


class ParameterError(SymbidError):
    """A node parameter of the wrong type or outside its range."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node, fixed when the node starts.

    Attributes
    ----------
    name, description : str
    default : bool, int, float, str or list of str
        Also fixes the type.
    minimum, maximum : float or None
        Inclusive range of a number.
    choices : tuple of str
        What a string may be; anything when empty.
    """

    name: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()

    def descriptor(self) -> ParameterDescriptor:
        """Return what ``ros2 param describe`` shows."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=self.description,
            additional_constraints=f"one of {', '.join(self.choices)}" if self.choices else "",
            read_only=True,
        )
        if self.minimum is not None or self.maximum is not None:
            if isinstance(self.default, int):
                descriptor.integer_range = [
                    IntegerRange(
                        from_value=int(self.minimum or 0),
                        to_value=LARGE_INTEGER if self.maximum is None else int(self.maximum),
                        step=1,
                    )
                ]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(
                        from_value=float(self.minimum or 0.0),
                        to_value=LARGE_NUMBER if self.maximum is None else float(self.maximum),
                    )
                ]
        return descriptor


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare parameters and return their values by name."""
    return {parameter.name: _declared(node, parameter) for parameter in parameters}


def _declared(node: Node, parameter: Parameter) -> Any:
    try:
        value = node.declare_parameter(
            parameter.name, parameter.default, parameter.descriptor()
        ).value
    except ParameterException as error:
        raise ParameterError(
            f"parameter {parameter.name}: not a valid value; give {_expected(parameter)}"
        ) from error
    if parameter.choices and value not in parameter.choices:
        raise ParameterError(
            f"parameter {parameter.name}: {value!r} is not known; give {_expected(parameter)}"
        )
    return value


def _expected(parameter: Parameter) -> str:
    if parameter.choices:
        return f"one of {', '.join(parameter.choices)}"
    kinds = {bool: "true or false", int: "an integer", float: "a number with a decimal point"}
    kind = kinds.get(type(parameter.default), "text")
    if isinstance(parameter.default, list):
        kind = "a list of texts"
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("at least", parameter.minimum), ("at most", parameter.maximum))
        if bound is not None
    ]
    return " ".join([kind, " and ".join(bounds)]).strip()
