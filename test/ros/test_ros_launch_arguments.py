"""Arguments of the launch files are complete, unambiguous and read correctly by the nodes."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from symbid_ros.ros.launch_arguments import (
    COMMON,
    FILES,
    argument_name,
    launch_arguments,
    node_arguments,
    node_parameters,
    parameter_file,
)
from symbid_ros.ros.parameters import ParameterError, declare

ROOT = Path(__file__).parents[2]
NODES = (
    *("mujoco_bridge", "balance_controller", "recorder", "player", "identifier", "monitor"),
    "web_monitor",
)
# Parameters with the same meaning in several nodes.
SHARED = {
    "as_flags": {"monitor", "web_monitor"},
    "bag": {"player", "identifier"},  # the input
    "base": {"identifier", "web_monitor"},
    "clock_rate": {"mujoco_bridge", "player"},
    "flip_joint": {"identifier", "web_monitor"},
    "hold_joint": {"identifier", "web_monitor"},
    "identifier": {"monitor", "web_monitor"},
    "joint_topic": {"identifier", "web_monitor"},
    "model": {"mujoco_bridge", "identifier", "web_monitor"},
    "motion_seed": {"mujoco_bridge", "balance_controller"},
    "moves": {"mujoco_bridge", "balance_controller"},
    "prior": {"identifier", "web_monitor"},
    "rename_joint": {"identifier", "web_monitor"},
    "scenario": {"mujoco_bridge", "balance_controller"},
    "wait_for_subscribers": {"mujoco_bridge", "player"},
}


@pytest.fixture
def context(domain: int) -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    yield context
    context.try_shutdown()


def read(context: Context, node: str, arguments: list[str]) -> dict[str, Any]:
    """Return the values that a node's parameters take on this command line."""
    subject = Node(node, context=context, cli_args=arguments, use_global_arguments=False)
    try:
        clock = subject.get_parameter("use_sim_time").value
        return declare(subject, node_parameters(node)) | {"use_sim_time": clock}
    finally:
        subject.destroy_node()


def calls(path: Path, name: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == name
    ]


@pytest.mark.parametrize("path", sorted((ROOT / "launch").glob("*.py")), ids=lambda path: path.name)
def test_a_launch_file_declares_the_arguments_of_all_nodes_that_it_starts(path: Path) -> None:
    (declared,) = calls(path, "launch_arguments")
    started = {
        word.value.value
        for call in calls(path, "Node")
        for word in call.keywords
        if word.arg == "executable"
    }
    assert {argument.value for argument in declared.args} == started
    assert {call.args[0].value for call in calls(path, "node_arguments")} == started


def test_every_parameter_has_an_argument_and_every_argument_one_meaning() -> None:
    owners = defaultdict(set)
    for node in NODES:
        names = {argument.name for argument in launch_arguments(node)}
        for parameter in node_parameters(node):
            name = argument_name(node, parameter.name)
            assert name in names
            owners[name].add(node)
    shared = {name: nodes for name, nodes in owners.items() if len(nodes) > 1}
    assert shared == SHARED
    assert not {argument.name for argument in COMMON} & set(owners)


@pytest.mark.parametrize("node", NODES)
def test_arguments_that_are_not_given_leave_every_default(context, node: str) -> None:
    empty = {argument.name: argument.default for argument in launch_arguments(node)}
    defaults = {parameter.name: parameter.default for parameter in node_parameters(node)}
    assert read(context, node, node_arguments(node, empty)) == defaults | {"use_sim_time": False}


@pytest.mark.parametrize(
    ("node", "texts", "values"),
    [
        (
            "identifier",
            {
                "bag": "log_1",
                "joint_topic": "[/arm/joint_states, /leg/joint_states]",
                "model": "123",
                "memory": "5",
                "rank": "7",
                "friction": "true",
                "sensor_errors": "gain: [x]",
                "prior_percent": "25",
                "sensor_std": "[0.1, 1, 0.1]",
                "use_sim_time": "True",
            },
            {
                "bag": ["log_1"],
                "joint_topic": ["/arm/joint_states", "/leg/joint_states"],
                "model": "123",
                "memory": 5.0,
                "rank": 7,
                "friction": True,
                "sensor_errors": ["gain: [x]"],
                "prior_percent": 25.0,
                "sensor_std": [0.1, 1.0, 0.1],
                "use_sim_time": True,
            },
        ),
        ("player", {"bag": "2024", "player_start": "1e1"}, {"bag": ["2024"], "start": 10.0}),
        ("recorder", {"recorder_bag": 'a "b" c', "bag": "other"}, {"bag": 'a "b" c'}),
        (
            "mujoco_bridge",
            {"payload_position": "[0, 0.5, -1]", "bridge_friction": "true", "friction": "false"},
            {"payload_position": [0.0, 0.5, -1.0], "friction": True},
        ),
    ],
)
def test_a_node_reads_arguments_in_the_types_of_its_parameters(
    context, node, texts, values
) -> None:
    found = read(context, node, node_arguments(node, texts))
    assert {name: found[name] for name in values} == values


def test_arguments_override_the_parameter_file_which_overrides_presets(context, tmp_path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(
        yaml.safe_dump({"/**": {"ros__parameters": {"wait_for_subscribers": False, "rate": 3.0}}})
    )
    given = {"params_file": str(file), "rate": "0.5"}
    preset = {"wait_for_subscribers": True, "lossless": False}
    found = read(context, "player", node_arguments("player", given, preset, publish_clock=True))
    names = ("wait_for_subscribers", "rate", "lossless", "publish_clock")
    assert [found[name] for name in names] == [False, 0.5, False, True]


@pytest.mark.parametrize(
    ("node", "name", "text", "says"),
    [
        ("identifier", "memory", "long", "launch argument memory: 'long' is not valid; give a num"),
        ("identifier", "friction", "perhaps", "launch argument friction: .* true or false"),
        ("recorder", "recorder_queue_depth", "1.5", "argument recorder_queue_depth: .* an integer"),
        ("mujoco_bridge", "payload_position", "[a]", "argument payload_position: .* 3 numbers"),
        ("player", "rate", ": [", "launch argument rate"),
    ],
)
def test_an_argument_that_is_not_of_its_type_is_refused_by_name(node, name, text, says) -> None:
    with pytest.raises(ParameterError, match=says):
        node_arguments(node, {name: text})


@pytest.mark.parametrize("node", list(FILES))
def test_the_parameter_file_states_the_nodes_own_defaults(node: str) -> None:
    text = (ROOT / "config" / FILES[node]).read_text()
    assert text == parameter_file(node), "run python -m symbid_ros.ros.launch_arguments"
    stated = yaml.safe_load(text)["/**"]["ros__parameters"]
    own = {parameter.name: parameter.default for parameter in node_parameters(node)}
    # A parameter without a default, such as a path, is left to the user.
    assert stated == {name: value for name, value in own.items() if value not in (None, "", [""])}
