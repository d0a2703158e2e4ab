"""Parameters that a node is given but does not have: ROS would ignore them silently."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from rclpy.node import Node

from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.user_files import load_yaml

NODES = (
    "balance_controller",
    "identifier",
    "monitor",
    "mujoco_bridge",
    "player",
    "recorder",
    "web_monitor",
)
OF_ROS = "qos_overrides."  # prefix of parameters that rclpy declares with a publisher


def require_known_parameters(node: Node, arguments: Sequence[str]) -> None:
    """Refuse unknown parameters of a node whose parameters are declared.

    Entries of a file for several nodes, such as ``/**``, may belong to another node of the
    package. If they belong to none, they are a warning.

    Parameters
    ----------
    node : Node
    arguments : sequence of str
        Command line of the process.

    Raises
    ------
    ParameterError
        When ``-p`` or a file's section of this node names an unknown parameter.
    """
    given = node._parameter_overrides  # rclpy has no other list of them
    unknown = {
        name for name in given if not node.has_parameter(name) and not name.startswith(OF_ROS)
    }
    if not unknown:
        return
    shared = _shared_names(arguments)
    declared = list(node._parameters)
    for name in sorted(unknown - shared):
        raise ParameterError(_describe(name, declared), "E801")
    for name in sorted(unknown - _names_of_all_nodes()):
        node.get_logger().warning(_describe(name, declared))


def _describe(name: str, known: Iterable[str]) -> str:
    similar = get_close_matches(name, list(known), 1)
    advice = f"did you mean {similar[0]}?" if similar else "remove it; --help lists all"
    return f"unknown parameter {name}; {advice}"


def _shared_names(arguments: Sequence[str]) -> set[str]:
    """Return names that parameter files give to several nodes, and ``-p`` does not give."""
    names: set[str] = set()
    for flag, value in pairwise(arguments):
        if flag == "--params-file":
            # rcl has read the file, but accepts more than plain YAML of limited size.
            try:
                content = load_yaml(Path(value))
            except (OSError, ValueError):
                continue
            names |= set(_wildcard_names(content))
    assigned = {
        value.partition(":=")[0].rpartition(":")[2]
        for flag, value in pairwise(arguments)
        if flag in ("-p", "--param")
    }
    return names - assigned


def _wildcard_names(content: Any) -> Iterator[str]:
    """Yield the parameters below sections whose name has a wildcard."""
    for section, entry in content.items() if isinstance(content, Mapping) else ():
        if "*" in str(section) and isinstance(entry, Mapping):
            yield from _flat(entry.get("ros__parameters"))


def _flat(values: Any, prefix: str = "") -> Iterator[str]:
    for name, value in values.items() if isinstance(values, Mapping) else ():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def _names_of_all_nodes() -> set[str]:
    names: set[str] = set()
    for node in NODES:
        try:
            parameters: tuple[Parameter, ...] = import_module(f"{__package__}.{node}").PARAMETERS
        except ModuleNotFoundError:  # an extra that this node does not need
            continue
        names |= {parameter.name for parameter in parameters}
    return names
