"""`symbid validate` and `symbid compare`: figures, exit statuses, JSON and bags for plots."""

import json
import re

import numpy as np
import pytest
from arm_log import arm_streams
from documented_robots import ur5_urdf
from foreign_bags import JOINT_STATE, joint_state, joints_only, write_rosbags
from json_schemas import require_valid
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import symbid_ros as sy
from symbid_ros.bags import read_truth
from symbid_ros.model.load import load_model


@pytest.fixture(scope="module")
def prior(symbid_here, model, tmp_path_factory):
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    ended = symbid_here("prior", "--model", model, "--percent", 25, "--seed", 3, "--out", path)
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


@pytest.fixture(scope="module")
def found(symbid_here, model, short, prior, tmp_path_factory):
    out = tmp_path_factory.mktemp("found") / "result"
    options = ("--prior", prior, "--unchecked", "--joint-terms", "none", "--out", out)
    ended = symbid_here("identify", short, "--model", model, *options)
    assert ended.returncode == 0
    assert re.search(r"held out: .* % → .* % of the measured torque on the last 1 s", ended.stdout)
    return out


def test_percentages_agree_with_an_evaluation_against_the_truth(
    symbid_here, model, ideal, prior, found, tmp_path
) -> None:
    ended = symbid_here("validate", found, "--bag", ideal, "--json")
    assert (ended.returncode, ended.stderr) == (0, "")
    figures = json.loads(ended.stdout)
    require_valid("validation", figures)
    effort = read_truth([ideal]).effort
    measured = np.sqrt(np.mean(np.sum(effort**2, axis=1)))
    assert figures["torque"]["measured"] == pytest.approx(measured, rel=0.01)
    for subject, when in ((prior, "before"), (found, "after")):
        options = ("--truth", model, "--bag", ideal, "--json")
        evaluated = symbid_here("evaluate", subject, *options)
        assert evaluated.returncode == 0
        torque = json.loads(evaluated.stdout)["torque_rmse"]
        assert figures[f"percent_{when}"] == pytest.approx(100 * torque / measured, rel=0.05)
    assert figures["advice"] == "better"
    assert figures["mass"]["measured_kg"] == pytest.approx(41.05, abs=0.02)


def test_the_table_ends_with_a_verdict(symbid_here, ideal, found) -> None:
    ended = symbid_here("validate", found, "--bag", ideal)
    assert (ended.returncode, ended.stderr) == (0, "")
    *_, verdict = ended.stdout.strip().splitlines()
    assert verdict.startswith("use it: ")
    assert verdict.endswith("on 6 s that were not used")
    for line in ("R_hfe", "base/force_z", "all joints", "total mass: ", "90 % interval"):
        assert line in ended.stdout
    shown = re.search(r"the forces show (\S+) ± (\S+) kg, if the sensors", ended.stdout)
    value, std = shown.groups()
    assert 0 < float(std) < 0.1
    assert len(value.partition(".")[2]) == len(std.partition(".")[2])


def test_a_result_that_is_not_better_ends_with_status_1(
    symbid_here, ideal, found, tmp_path
) -> None:
    """Values and prior exchanged: the identified model is the wrong one."""
    worse = tmp_path / "worse"
    worse.mkdir()
    for file in found.iterdir():
        (worse / file.name).write_bytes(file.read_bytes())
    document = json.loads((found / "estimate.json").read_text())
    for one in document["parameters"].values():
        one["value"], one["prior"] = one["prior"], one["value"]
    (worse / "estimate.json").write_text(json.dumps(document))
    ended = symbid_here("validate", worse, "--bag", ideal)
    assert (ended.returncode, ended.stderr) == (1, "")
    assert "do not use it, it is worse than the original" in ended.stdout
    ended = symbid_here("compare", worse, worse, "--bag", ideal)
    assert (ended.returncode, ended.stderr) == (1, "")
    assert "none is clearly better than the original model" in ended.stdout

    ranked = symbid_here("compare", worse, found, "--bag", ideal, "--json")
    assert (ranked.returncode, ranked.stderr) == (0, "")
    comparison = json.loads(ranked.stdout)
    require_valid("comparison", comparison)
    assert [one["result"] for one in comparison["ranking"]] == [str(found), str(worse)]
    assert comparison["verdict"].startswith(f"{found} predicts best")
    shown = symbid_here("compare", worse, found, "--bag", ideal).stdout
    assert "both in the unit of measured" in shown
    assert "–" not in shown
    assert comparison["verdict"] in shown


def test_predicted_efforts_are_a_bag(symbid_here, ideal, found, tmp_path) -> None:
    folder = tmp_path / "predictions"
    options = ("--bag", ideal, "--predictions", folder)
    assert symbid_here("validate", found, *options).returncode == 0
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        read: dict[str, list] = {}
        for connection, time, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            assert time == stamp.sec * 1_000_000_000 + stamp.nanosec
            read.setdefault(connection.topic, []).append(message)
    names = "measured", "original", "identified"
    assert set(read) == {
        f"/{name}/{kind}" for name in names for kind in ("joint_states", "base_wrench")
    }
    efforts = {
        name: np.array([message.effort for message in read[f"/{name}/joint_states"]])
        for name in names
    }
    first = read["/measured/joint_states"][0]
    assert (len(first.position), len(first.velocity)) == (0, 0)
    figures = json.loads(symbid_here("validate", found, "--bag", ideal, "--json").stdout)
    errors = {one["name"]: one for one in figures["coordinates"]}
    for name, key in (("original", "rmse_before"), ("identified", "rmse_after")):
        rmse = np.sqrt(np.mean((efforts["measured"] - efforts[name]) ** 2, axis=0))
        expected = [errors[joint][key] for joint in first.name]
        np.testing.assert_allclose(rmse, expected, rtol=1e-6, atol=1e-9)
    weight = np.mean([m.wrench.force.z for m in read["/measured/base_wrench"]])
    assert weight > 300
    assert read["/measured/base_wrench"][0].header.frame_id == "base_link"

    again = symbid_here("validate", found, *options)
    assert again.returncode == 2
    assert "exists; choose another --predictions" in again.stderr


def test_errors_are_one_line_and_status_2(symbid_here, ideal, tmp_path) -> None:
    for words in (
        ("validate", tmp_path / "gone", "--bag", ideal),
        ("compare", tmp_path / "gone", "--bag", ideal),
    ):
        ended = symbid_here(*words)
        assert (ended.returncode, ended.stdout) == (2, "")
        assert ended.stderr.count("\n") == 1


WRIST = "wrist_3_joint"


@pytest.fixture(scope="module")
def wristless(tmp_path_factory) -> list:
    """Two bags of an arm whose last joint rests at 0 and is not recorded."""
    arm = load_model(ur5_urdf(), "fixed")
    bags = []
    for seed in (1, 2):
        read = arm_streams(arm, 12.0, seed, friction=0.05, resting=[WRIST]).joints
        kept = [place for place, name in enumerate(read.names) if name != WRIST]
        names = [read.names[place] for place in kept]
        columns = read.position[:, kept], read.velocity[:, kept], read.effort[:, kept]
        rows = zip(read.stamp, *columns, strict=True)
        messages = [joint_state(int(stamp), names, *row) for stamp, *row in rows]
        bags.append(joints_only(tmp_path_factory.mktemp("arm") / f"bag_{seed}", *messages))
    return bags


@pytest.fixture(scope="module")
def wristless_result(symbid_here, wristless, tmp_path_factory):
    out = tmp_path_factory.mktemp("arm_result") / "result"
    options = ("--base", "fixed", "--joint-terms", "viscous,coulomb", "--no-holdout")
    ended = symbid_here("identify", wristless[0], "--model", ur5_urdf(), *options, "--out", out)
    assert ended.returncode < 2, ended.stderr
    assert ended.stderr.count(f"has no joint {WRIST}, held at 0") == 1
    # Its driver could not fill an effort of it.
    assert "JointState.effort" not in ended.stderr + ended.stdout
    return out


@pytest.mark.parametrize("held", [(), ("--hold-joint", f"{WRIST}:=0.0")], ids=["default", "named"])
def test_a_joint_that_neither_log_has_is_held_as_in_the_identification(
    symbid_here, wristless, wristless_result, held
) -> None:
    ended = symbid_here("validate", wristless_result, "--bag", wristless[1], *held)
    assert ended.returncode < 2, ended.stderr
    assert ended.stderr.count(f"has no joint {WRIST}, held at 0") == (not held)
    ranked = symbid_here("compare", *[wristless_result] * 2, "--bag", wristless[1], *held)
    assert ranked.returncode < 2, ranked.stderr
    assert ranked.stderr.count(f"has no joint {WRIST}, held at 0") == (not held)


def test_bags_are_read_like_that_of_the_identification(symbid_here, tmp_path) -> None:
    """Topics and names need not be given again."""
    arm = load_model(ur5_urdf(), "fixed")
    bags = []
    for seed in (1, 2):
        joints = arm_streams(arm, 12.0, seed, friction=0.05).joints
        names = [f"axis_{place}" for place in range(len(joints.names))]
        rows = zip(joints.stamp, joints.position, joints.velocity, joints.effort, strict=True)
        messages = [
            ("/arm/measured", JOINT_STATE, joint_state(int(stamp), names, *row))
            for stamp, *row in rows
        ]
        bags.append(write_rosbags(tmp_path / f"bag_{seed}", messages))
    named = [f"--rename-joint=axis_{place}:={name}" for place, name in enumerate(arm.joint_names)]
    result = tmp_path / "result"
    options = ("--base", "fixed", "--joint-terms", "viscous,coulomb", "--no-holdout")
    options += ("--joint-topic", "/arm/measured", *named, "--out", result)
    ended = symbid_here("identify", bags[0], "--model", ur5_urdf(), *options)
    assert ended.returncode < 2, ended.stderr
    for command in ("validate", "compare", "report"):
        ended = symbid_here(command, result, "--bag", bags[1])
        assert ended.returncode < 2, ended.stderr
    assert ended.stdout == f"wrote {result / 'report.html'}\n"


def test_a_log_that_was_read_without_a_robot_is_one_of_the_robot_it_is_used_with(
    wristless, wristless_result
) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    alone, named = sy.load_bag(wristless[1]), sy.load_bag(wristless[1], arm)
    found, expected = (sy.validate(wristless_result, log) for log in (alone, named))
    assert found.is_better
    assert found.verdict == expected.verdict
    assert sy.diagnose(arm, alone).severity == sy.diagnose(arm, named).severity
    given = {"joint_terms": ("viscous", "coulomb"), "no_holdout": True}
    result = sy.identify(arm, alone, **given)
    assert result.predict(alone).rmse == pytest.approx(result.predict(named).rmse)


def test_the_doctor_says_once_that_a_joint_is_held(symbid_here, wristless) -> None:
    options = ("--model", ur5_urdf(), "--base", "fixed")
    ended = symbid_here("bag", "doctor", wristless[0], *options)
    assert ended.returncode < 2, ended.stdout
    assert ended.stderr.count(f"has no joint {WRIST}, held at 0") == 1
