"""``symbid excite`` and its rehearsal by ``symbid simulate`` as a user runs them."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from documented_robots import ur5_urdf
from json_schemas import require_valid
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

QUICK = "--period", 5, "--seconds", 20, "--harmonics", 3, "--starts", 1, "--iterations", 10
ARM = "--model", ur5_urdf(), "--base", "fixed"


@pytest.fixture(scope="module")
def planned(symbid_here, tmp_path_factory):
    folder = tmp_path_factory.mktemp("excite") / "plan"
    done = symbid_here("excite", *ARM, *QUICK, "--out", folder)
    assert done.returncode == 0
    return folder, done.stdout


def test_all_files_hold_the_same_trajectory(planned):
    folder, _ = planned
    plan = json.loads((folder / "plan.json").read_text())
    require_valid("plan", plan)
    with (folder / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    goal = yaml.safe_load((folder / "goal.yaml").read_text())["trajectory"]
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([folder / "trajectory_bag"], default_typestore=store) as reader:
        ((connection, _, payload),) = reader.messages()
        message = reader.deserialize(payload, connection.msgtype)
    assert connection.topic == "/joint_trajectory_controller/joint_trajectory"
    assert message.joint_names == goal["joint_names"] == list(plan["joints"])
    assert len(message.points) == len(goal["points"])
    by_time = {round(float(row["time"]), 6): row for row in rows}
    compared = 0
    for ours, theirs in zip(message.points, goal["points"], strict=True):
        stamp = ours.time_from_start.sec + 1e-9 * ours.time_from_start.nanosec
        assert stamp == pytest.approx(
            theirs["time_from_start"]["sec"] + 1e-9 * theirs["time_from_start"]["nanosec"]
        )
        np.testing.assert_allclose(ours.positions, theirs["positions"], atol=1e-7)
        row = by_time.get(round(stamp - plan["approach_s"], 6))
        if row is not None:
            for kind, values in (
                ("position", ours.positions),
                ("velocity", ours.velocities),
                ("acceleration", ours.accelerations),
            ):
                wanted = [float(row[f"{name}/{kind}"]) for name in goal["joint_names"]]
                np.testing.assert_allclose(values, wanted, atol=1e-7)
            compared += 1
    assert compared > 10
    assert float(rows[-1]["time"]) == 20.0


def test_the_terminal_shows_limits_and_expected_deviations(planned):
    folder, shown = planned
    plan = json.loads((folder / "plan.json").read_text())
    used = plan["joints"]["elbow_joint"]["used"]
    assert max(max(each["used"].values()) for each in plan["joints"].values()) <= 0.951
    row = next(line for line in shown.splitlines() if "elbow_joint" in line)
    assert f"{100 * used['velocity']:.0f}" in row
    assert "wrist_3_link" in shown
    assert "assumed: elbow_joint: acceleration 6.3" in shown


def test_a_rehearsal_identifies_the_true_robot(planned, symbid_here, tmp_path):
    folder, _ = planned
    bag, result = tmp_path / "bag", tmp_path / "result"
    done = symbid_here(
        *("simulate", *ARM, "--trajectory", folder, "--truth-seed", 1),
        *("--friction", "--out", bag),
    )
    assert done.returncode == 0
    assert "bag_truth.xml" in done.stdout
    prior = folder / "prior.json"
    done = symbid_here("identify", bag, *ARM, "--prior", prior, "--out", result)
    assert done.returncode == 0
    plan = json.loads((folder / "plan.json").read_text())["parameters"]
    estimate = json.loads((result / "estimate.json").read_text())["parameters"]
    truth = ParameterSet(load_model(tmp_path / "bag_truth.xml"), ("viscous", "coulomb", "armature"))
    exact = dict(zip(truth.names, truth.values.tolist(), strict=True))
    known = [name for name, each in plan.items() if each["determined"] and name in exact]
    error = [(estimate[name]["value"] - exact[name]) / plan[name]["std_expected"] for name in known]
    assert len(known) > 30
    assert 0.5 < np.sqrt(np.mean(np.square(error))) < 1.6
    errors = []
    for estimate in (result, _prior(symbid_here, tmp_path)):
        truth = tmp_path / "bag_truth.xml"
        done = symbid_here("evaluate", estimate, "--truth", truth, "--bag", bag, "--json")
        assert (done.returncode, done.stderr) == (0, "")
        errors.append(json.loads(done.stdout)["torque_rmse"])
    # What remains is friction of joints at rest, which no model of the log contains.
    assert errors[0] < 0.2 * errors[1]


def _prior(symbid_here, folder) -> Path:
    """Return a prior with the values of the model file, to the digit that matters."""
    path = folder / "prior.json"
    assert symbid_here("prior", *ARM, "--percent", 1e-6, "--out", path).returncode == 0
    return path


def test_an_earlier_result_is_planned_for(planned, symbid_here, tmp_path):
    """The next trajectory starts from what is known, and the identification from its data."""
    folder, _ = planned
    bag, result, plan = (tmp_path / name for name in ("bag", "result", "plan"))
    symbid_here("simulate", *ARM, "--trajectory", folder, "--friction", "--out", bag)
    terms = "--joint-terms", "viscous,coulomb,armature"
    symbid_here("identify", bag, *ARM, *terms, "--prior", folder / "prior.json", "--out", result)
    done = symbid_here("excite", *ARM, *QUICK, "--information", result, "--out", plan)
    assert (done.returncode, "prior.json" in done.stdout) == (0, False)
    found = json.loads((result / "estimate.json").read_text())["parameters"]
    next_plan = json.loads((plan / "plan.json").read_text())["parameters"]
    assert set(next_plan) == set(found)
    for name, each in next_plan.items():
        assert each["std_before"] == pytest.approx(found[name]["std"], rel=0.05) or "/m" in name
        assert each["std_expected"] <= each["std_before"]


def test_options_of_scenarios_and_trajectories_are_not_mixed(planned, symbid_here, tmp_path):
    folder, _ = planned
    done = symbid_here(
        "simulate", *ARM, "--trajectory", folder, "--moves", 3, "--out", tmp_path / "bag"
    )
    assert (done.returncode, "--moves" in done.stderr) == (2, True)
    done = symbid_here("simulate", *ARM, "--out", tmp_path / "bag")
    assert (done.returncode, "--trajectory" in done.stderr) == (2, True)


def test_an_earlier_plan_stays(planned, symbid_here):
    folder, _ = planned
    done = symbid_here("excite", *ARM, *QUICK, "--out", folder)
    assert (done.returncode, "--overwrite" in done.stderr) == (2, True)


def test_ctrl_c_keeps_the_best_trajectory_so_far(symbid_here, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(TrajectoryOptimizer, "_climb", interrupted)
    folder = tmp_path / "plan"
    done = symbid_here("excite", *ARM, *QUICK, "--out", folder)
    assert (done.returncode, "best trajectory so far" in done.stderr) == (0, True)
    assert json.loads((folder / "plan.json").read_text())["is_complete"] is False
