"""Parameter files of commit 17d344f still set up every node."""

from pathlib import Path

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from symbid_ros.ros import (
    balance_controller,
    identifier_parameters,
    mujoco_bridge,
    player,
    recorder,
)
from symbid_ros.ros.parameters import declare

FILES = Path(__file__).parents[1] / "estimation" / "data" / "earlier_files" / "node_parameters"
NODES = {
    "balance_controller": balance_controller,
    "bridge": mujoco_bridge,
    "identifier": identifier_parameters,
    "player": player,
    "recorder": recorder,
}


@pytest.mark.parametrize("name", NODES)
def test_each_parameter_is_declared_and_keeps_its_value(name: str, domain: int) -> None:
    path = FILES / f"{name}.yaml"
    stored = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node(name, context=context, cli_args=["--ros-args", "--params-file", str(path)])
    try:
        values = declare(node, NODES[name].PARAMETERS)
    finally:
        node.destroy_node()
        context.try_shutdown()
    for key, value in stored.items():
        # A single text is read as a list of one.
        expected = [value] if isinstance(values[key], list) and isinstance(value, str) else value
        assert values[key] == expected, key
