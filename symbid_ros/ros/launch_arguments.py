"""Launch arguments and the files config/*.yaml, generated from the parameters of the nodes.

Launch files get the names, descriptions and command lines from here and repeat no parameter. This
module does not import launch. Run ``python -m symbid_ros.ros.launch_arguments`` after a change of
parameters: it writes the files.
"""

import json
import textwrap
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from symbid_ros.package_paths import share_directory
from symbid_ros.ros.parameters import Parameter, ParameterError

# Launch arguments of parameters whose names have another meaning in another node.
RENAMED = {
    ("mujoco_bridge", "friction"): "bridge_friction",
    ("mujoco_bridge", "queue_depth"): "bridge_queue_depth",
    ("balance_controller", "model"): "controller_model",
    ("recorder", "bag"): "recorder_bag",
    ("recorder", "topics"): "recorder_topics",
    ("recorder", "queue_depth"): "recorder_queue_depth",
    ("player", "start"): "player_start",
    ("player", "topics"): "player_topics",
    ("player", "queue_depth"): "player_queue_depth",
}
WIDTH = 96  # of a parameter file
FILES = {
    "balance_controller": "balance_controller.yaml",
    "identifier": "identifier.yaml",
    "mujoco_bridge": "bridge.yaml",
    "player": "player.yaml",
    "recorder": "recorder.yaml",
}


class LaunchArgument(NamedTuple):
    """An argument of a launch file; empty, it leaves the value to params_file and the node."""

    name: str
    default: str
    description: str


COMMON = (
    LaunchArgument("namespace", "", "namespace of the nodes"),
    LaunchArgument("params_file", "", "parameter file for the nodes; arguments override it"),
    LaunchArgument("log_level", "info", "level of the nodes' messages"),
)


def node_parameters(node: str) -> tuple[Parameter, ...]:
    """Return the parameters of one of the package's executables."""
    parameters: tuple[Parameter, ...] = import_module(f"{__package__}.{node}").PARAMETERS
    return parameters


def argument_name(node: str, parameter: str) -> str:
    """Return the name of the launch argument that sets a node's parameter."""
    return RENAMED.get((node, parameter), parameter)


def launch_arguments(*nodes: str) -> tuple[LaunchArgument, ...]:
    """Return the arguments of a launch file that starts these nodes.

    Parameters
    ----------
    *nodes : str
        Executables. If two have a parameter of the same name, the first one describes it.
    """
    found = {common.name: common for common in COMMON}
    for node in nodes:
        for parameter in node_parameters(node):
            name = argument_name(node, parameter.name)
            text = f"{node}: {parameter.description}"
            if parameter.default is not None and "Default:" not in text:
                text += f" Default: {json.dumps(parameter.default)}."
            found.setdefault(name, LaunchArgument(name, "", text))
    return tuple(found.values())


def node_arguments(
    node: str,
    configurations: Mapping[str, str],
    preset: Mapping[str, Any] | None = None,
    **fixed: Any,
) -> list[str]:
    """Return the command line of a node.

    Parameters
    ----------
    node : str
        Executable of the node.
    configurations : mapping of str to str
        Launch arguments by name; empty ones count as not given.
    preset : mapping of str to object, optional
        Parameters of this node that a parameter file overrides.
    **fixed : object
        Parameters that cannot be overridden.

    Raises
    ------
    ParameterError
        When an argument is not a valid value of its parameter.
    """
    arguments = ["--ros-args"]
    for name, value in (preset or {}).items():
        arguments += ["-p", f"{name}:={json.dumps(value)}"]
    if file := configurations.get("params_file"):
        arguments += ["--params-file", file]
    given: dict[str, Any] = {}
    if text := configurations.get("use_sim_time"):
        given["use_sim_time"] = _value(Parameter("use_sim_time", False, ""), "use_sim_time", text)
    for parameter in node_parameters(node):
        name = argument_name(node, parameter.name)
        if text := configurations.get(name):
            given[parameter.name] = _value(parameter, name, text)
    for name, value in (given | fixed).items():
        arguments += ["-p", f"{name}:={json.dumps(value)}"]
    return [*arguments, "--log-level", configurations.get("log_level") or "info"]


def _value(parameter: Parameter, name: str, text: str) -> Any:
    """Return the value of a launch argument in the type of its parameter."""
    default = parameter.default
    kind = type(default) if parameter.kind is None else parameter.kind
    if kind is str:
        return text
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = text
    if isinstance(default, list) and isinstance(default[0], str):
        texts = value if isinstance(value, list) else [text]
        return [str(each) for each in texts]
    if kind is list or parameter.length:
        is_valid = isinstance(value, list) and all(_is_number(each) for each in value)
        value = [float(each) for each in value] if is_valid else value
    elif kind is float:
        try:
            return float(text)
        except ValueError:
            is_valid = False
    else:
        is_valid = type(value) is kind
    if not is_valid:
        raise ParameterError(
            f"launch argument {name}: {text!r} is not valid; give {parameter.expected}", "E801"
        )
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def parameter_file(node: str) -> str:
    """Return the parameter file of a node with the defaults of all parameters.

    Parameters without a default are commented out.
    """
    lines = [f"# Parameters of the node `{node}` and their defaults.", "/**:", "  ros__parameters:"]
    for parameter in node_parameters(node):
        about = textwrap.wrap(parameter.description, WIDTH - 6)
        lines += [f"    # {line}" for line in about]
        if parameter.default in (None, "", [""]):
            lines.append(f"    # {parameter.name}:")
        else:
            lines.append(f"    {parameter.name}: {_text(parameter.default)}")
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000)
    return text.removesuffix("\n").removesuffix("\n...")


def main() -> None:
    """Write all parameter files."""
    for node, name in FILES.items():
        Path(share_directory() / "config" / name).write_text(parameter_file(node))


if __name__ == "__main__":
    main()
