"""What every node's process does before there is a graph."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from symbid_ros.ros import identifier, mujoco_bridge, recorder
from symbid_ros.share import config_file

NODES = {
    "mujoco_bridge": mujoco_bridge.PARAMETERS,
    "recorder": recorder.PARAMETERS,
    "identifier": identifier.PARAMETERS,
}


def run(executable: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [Path(sys.executable).parent / executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize("name", NODES)
def test_help_tells_every_parameter(name: str) -> None:
    ended = run(name, "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    for parameter in NODES[name]:
        assert f"{parameter.name} ({parameter.default!r}): {parameter.description}" in ended.stdout


@pytest.mark.parametrize("name", NODES)
def test_arguments_of_no_meaning_are_refused(name: str) -> None:
    ended = run(name, "--bag", "log")
    assert ended.returncode == 2
    assert f"{name}: error: unrecognized arguments: --bag log" in ended.stderr


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


@pytest.mark.parametrize("name", NODES)
def test_shipped_parameter_file_names_only_real_parameters(name: str) -> None:

    file = config_file({"mujoco_bridge": "bridge.yaml"}.get(name, f"{name}.yaml"))
    values = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    declared = {parameter.name: parameter.default for parameter in NODES[name]}
    for key, value in values.items():
        assert type(value) is type(declared[key])
