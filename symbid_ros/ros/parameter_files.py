"""The files config/*.yaml, generated from the parameters that the nodes declare.

Run ``python -m symbid_ros.ros.parameter_files`` after a change of parameters.
"""

import textwrap
from pathlib import Path
from typing import Any

import yaml

from symbid_ros.package_paths import share_directory
from symbid_ros.ros.launch_arguments import node_parameters

WIDTH = 96
FILES = {
    "balance_controller": "balance_controller.yaml",
    "identifier": "identifier.yaml",
    "mujoco_bridge": "bridge.yaml",
    "player": "player.yaml",
    "recorder": "recorder.yaml",
}


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
