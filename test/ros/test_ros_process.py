"""Start, arguments and parameters of every node's process, without a ROS graph."""

import math
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node

from symbid_ros.package_paths import config_file
from symbid_ros.ros import (
    balance_controller,
    identifier,
    monitor,
    mujoco_bridge,
    player,
    recorder,
    start,
)
from symbid_ros.ros.parameters import Parameter, ParameterError, declare
from symbid_ros.ros.unknown_parameters import require_known_parameters

NODES = {
    "mujoco_bridge": mujoco_bridge.PARAMETERS,
    "balance_controller": balance_controller.PARAMETERS,
    "recorder": recorder.PARAMETERS,
    "identifier": identifier.PARAMETERS,
    "player": player.PARAMETERS,
    "monitor": monitor.PARAMETERS,
}
EVERY_PARAMETER = [
    pytest.param(parameter, id=f"{name}-{parameter.name}")
    for name, parameters in NODES.items()
    for parameter in parameters
]


def kind_of(parameter: Parameter) -> type:
    """Return the type of a parameter's values."""
    return type(parameter.default) if parameter.kind is None else parameter.kind


def run(executable: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [Path(sys.executable).parent / executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


@pytest.fixture
def answer(monkeypatch, capsys) -> Iterator[Callable[..., tuple[int, str, str]]]:
    """Give arguments to a node in this process; return its exit status and what it prints."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def call(name: str, *arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        with pytest.raises(SystemExit) as ended:
            getattr(start, name)()
        return int(ended.value.code or 0), *capsys.readouterr()

    yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", NODES)
def test_help_lists_every_parameter_within_the_terminal(answer, monkeypatch, name: str) -> None:
    monkeypatch.setenv("COLUMNS", "70")
    status, out, err = answer(name, "--help")
    assert (status, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 70
    words = " ".join(out.split())
    for parameter in NODES[name]:
        text = f"{parameter.name} ({parameter.default!r}): {parameter.description}"
        assert " ".join(text.split()) in words


@pytest.mark.parametrize("name", NODES)
def test_an_interruption_while_libraries_load_leaves_no_traceback(name: str) -> None:
    command = [Path(sys.executable).parent / name, "--help"]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        libraries = Path(f"/proc/{process.pid}/maps")
        while process.poll() is None and "rclpy" not in libraries.read_text():
            pass
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=300)
    assert process.returncode in (0, 130)
    assert err == ""


@pytest.mark.parametrize("name", NODES)
def test_unknown_arguments_are_refused(answer, name: str) -> None:
    status, _, err = answer(name, "--bag", "log")
    assert status == 2
    assert f"{name}: error: unrecognized arguments: --bag log" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("-p", "bag"),
        ("-p", "use_sim_time:=nonsense"),
        ("--params-file", "/nowhere.yaml"),
        ("-r", "__ns:=a//b"),
    ],
)
def test_malformed_ros_arguments_end_without_traceback(arguments: tuple[str, ...]) -> None:
    ended = run("recorder", "--ros-args", *arguments)
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1].startswith("recorder: ")
    assert ended.stderr.rstrip().endswith("check --ros-args")
    assert "Traceback" not in ended.stderr


def test_an_invalid_domain_is_named(monkeypatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "my_robot")
    ended = run("recorder")
    assert ended.returncode == 2
    assert "ROS_DOMAIN_ID is not an integral number" in ended.stderr
    assert ended.stderr.rstrip().endswith("; correct that environment variable")


@pytest.mark.parametrize("is_in_file", [False, True])
def test_a_list_entry_with_a_colon_needs_quotes(tmp_path: Path, is_in_file: bool) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("/**:\n  ros__parameters:\n    rename_joint: [j1:=R_haa]\n")
    given = ("--params-file", file) if is_in_file else ("-p", "contact:=[left_sole:point]")
    ended = run("identifier", "--ros-args", *map(str, given))
    assert ended.returncode == 2
    assert "; quote list entries with colons, and check --ros-args" in ended.stderr


# The monitor has no parameter file.
@pytest.mark.parametrize("name", [name for name in NODES if name != "monitor"])
def test_shipped_parameter_file_names_only_real_parameters(name: str) -> None:
    file = config_file({"mujoco_bridge": "bridge.yaml"}.get(name, f"{name}.yaml"))
    values = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    declared = {parameter.name: kind_of(parameter) for parameter in NODES[name]}
    for key, value in values.items():
        # A list of texts may be given as a single text.
        assert type(value) is declared[key] or (declared[key], type(value)) == (list, str)


@pytest.mark.parametrize("parameter", EVERY_PARAMETER)
def test_every_parameter_describes_its_purpose_and_range(parameter: Parameter) -> None:
    shown = parameter.descriptor()
    assert shown.description.endswith(".")
    assert shown.read_only != parameter.live
    default = parameter.default
    values = default if isinstance(default, list) else [default]
    kind = type(values[0]) if parameter.kind is None else parameter.kind
    if kind in (bool, str):
        assert not shown.integer_range
        assert not shown.floating_point_range
        assert all(choice in shown.additional_constraints for choice in parameter.choices)
        return
    if default is None:
        assert shown.additional_constraints.endswith(", or not set")
        assert shown.dynamic_typing
        return
    (bounds,) = shown.integer_range if kind is int else shown.floating_point_range
    assert all(bounds.from_value <= one <= bounds.to_value for one in values)
    assert math.isfinite(bounds.from_value)
    assert math.isfinite(bounds.to_value)


@pytest.mark.parametrize("name", NODES)
def test_a_module_of_a_node_runs_it(name: str) -> None:
    module = Path(start.__file__).with_name(f"{name}.py").read_text()
    assert module.endswith('if __name__ == "__main__":\n    sys.exit(main())\n')


def test_an_unknown_parameter_is_refused_with_the_right_name() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "symbid_ros.ros.identifier", "--ros-args", "-p", "memroy:=10.0"],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.endswith("unknown parameter memroy; did you mean memory? (SYMBID-E801)")


@pytest.mark.parametrize(
    ("section", "arguments", "says"),
    [
        ("subject", (), "error"),
        ("/**", (), "warning"),
        ("/**", ("-p", "memroy:=1.0"), "error"),
    ],
)
def test_a_file_of_several_nodes_may_name_parameters_of_others(
    domain: int, tmp_path: Path, capfd, section: str, arguments: tuple[str, ...], says: str
) -> None:
    file = tmp_path / "robot.yaml"
    entries = {"memroy": 10.0, "memory": 5.0}
    if section == "/**":
        entries |= {"rate": 2.0}  # of the player
    file.write_text(yaml.safe_dump({section: {"ros__parameters": entries}}))
    command = ["subject", "--ros-args", "--params-file", str(file), *arguments]
    context = Context()
    rclpy.init(args=command, context=context, domain_id=domain)
    node = Node("subject", context=context)
    declare(node, [Parameter("memory", 0.0, "Of data.")])
    try:
        if says == "error":
            with pytest.raises(ParameterError, match="memroy; did you mean memory"):
                require_known_parameters(node, command)
        else:
            require_known_parameters(node, command)
            (line,) = capfd.readouterr().err.splitlines()
            assert "unknown parameter memroy; did you mean memory?" in line
    finally:
        node.destroy_node()
        context.try_shutdown()
