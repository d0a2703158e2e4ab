"""The examples run as their texts say."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest
from preloaded import PreloadedProcess
from random_robots import random_robot
from tree_simulation import TreeSimulation

import symbid_ros as sy
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.recording import record

EXAMPLES = Path(__file__).parents[1] / "examples"
SCENARIO = {"moves": 1, "motion_seed": 3, "noise_seed": 4}


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated("smooth", **SCENARIO)


def run(script: str, *words: object, cwd: Path) -> str:
    command = [str(EXAMPLES / script), *map(str, words)]
    with contextlib.chdir(cwd):
        process = PreloadedProcess("preloaded:run_script", command, os.environ, cwd / script)
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    return out


def test_an_arm_identified_from_arrays_has_the_true_mass(tmp_path) -> None:
    said = run("arm_from_arrays.py", cwd=tmp_path)
    assert "0 alarms" in said
    errors = [float(line.split()[-2]) for line in said.splitlines() if "another motion" in line]
    assert len(errors) == 2
    assert max(errors) < 0.05  # Nm, noise averaged over windows


def test_a_legged_robot_from_a_bag(bag, tmp_path) -> None:
    said = run("legged_from_bag.py", bag, config_file("symbitron.urdf"), "out", cwd=tmp_path)
    assert "L_thigh: " in said
    assert (tmp_path / "out" / "model.urdf").is_file()


def test_logs_are_merged(tmp_path) -> None:
    robot, model = random_robot(1, links=4, wrench_frames=1), tmp_path / "robot.xml"
    parameters = ParameterSet(robot)
    drawn = draw_prior(parameters, "consistent", 25, 1)
    model.write_text(mjcf_text(parameters.apply(drawn.mean)))
    bags = [tmp_path / "first", tmp_path / "second"]
    for seed, each in enumerate(bags):
        record(TreeSimulation(robot, 2.5, seed), each)
    said = run("merge_logs.py", model, *bags, cwd=tmp_path)
    true = robot.phi[:, 0].sum()
    for line in said.splitlines():
        mass, determined = (float(part.split()[0]) for part in line.split(": ")[1].split("kg, "))
        # All force sensors may share a gain of 1 %.
        assert mass == pytest.approx(true, rel=0.01)
        assert determined > len(parameters) / 2
    saved = sy.LogInformation.load(tmp_path / "information.npz")
    both = sy.identify(sy.load_model(model), saved, method="map")
    assert f"{sum(link.mass for link in both.links.values()):.3f} kg" in said.splitlines()[-1]


def test_the_regressor_alone(tmp_path) -> None:
    model = tmp_path / "arm.urdf"
    model.write_text(urdf_text(random_robot(2, links=4, floating=False, wrench_frames=0)))
    said = run("regressor_alone.py", model, cwd=tmp_path)
    assert float(said.split()[-2]) < 1e-9


def test_a_node_prints_the_live_estimate(bag, domain, tmp_path) -> None:
    identifier = [sys.executable, "-c", "from symbid_ros.ros.start import identifier; identifier()"]
    parameters = {"bag": f"['{bag}']", "model": config_file("symbitron.urdf")}
    given = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    printer = [sys.executable, str(EXAMPLES / "live_node.py"), "L_thigh"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with (
        subprocess.Popen([*identifier, "--ros-args", *given], cwd=tmp_path) as node,
        subprocess.Popen(printer, stdout=subprocess.PIPE, text=True, env=environment) as example,
    ):
        try:
            line = example.stdout.readline()
        finally:
            for process in (node, example):
                process.send_signal(signal.SIGINT)
    assert line.startswith("L_thigh: ")
    assert "kg" in line


def test_the_notebooks_cells_run_in_order(bag, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")
    cells = json.loads((EXAMPLES / "identify.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    exec(code[0], names)
    names |= {"bag": bag, "model": config_file("symbitron.urdf")}
    for cell in code[1:]:
        exec(cell, names)
    assert (tmp_path / "notebook_result" / "estimate.json").is_file()
