"""What a user gets wrong ends with one line that helps, and costs nothing."""

import json
from pathlib import Path

import pytest

from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator


@pytest.fixture
def good(model, log, tmp_path) -> dict[str, object]:
    return {"bag": log, "model": model, "rank": 10, "out": tmp_path / "out"}


def fails(symbid, *words: str, **given: object) -> str:
    arguments = [given.pop("bag")] if "bag" in given else []
    for name, value in given.items():
        arguments += [f"--{name.replace('_', '-')}", value]
    ended = symbid("identify", *arguments)
    assert ended.returncode == 2, ended.stderr
    assert ended.stdout == ""
    assert ended.stderr.startswith("symbid: ")
    assert ended.stderr.count("\n") == 1, ended.stderr
    for word in words:
        assert word in ended.stderr
    assert not Path(str(given.get("out"))).exists()
    return ended.stderr


def test_a_missing_bag(symbid, good) -> None:
    fails(symbid, "nowhere", **good | {"bag": "nowhere"})


def test_a_file_that_is_no_bag(symbid, good, tmp_path) -> None:
    (tmp_path / "notes.mcap").write_text("not a bag")
    fails(symbid, "notes.mcap", **good | {"bag": tmp_path / "notes.mcap"})


def test_a_missing_model(symbid, good) -> None:
    fails(symbid, "nowhere.urdf", **good | {"model": "nowhere.urdf"})


def test_a_model_with_other_joints(symbid, good, model, tmp_path) -> None:
    other = tmp_path / "other.xml"
    other.write_text(model.read_text().replace("R_kfe", "R_knee"))
    fails(symbid, "R_knee", **good | {"model": other})


def test_a_prior_of_another_model(symbid, good, tmp_path) -> None:
    prior = {"model": "other", "kind": "percent", "seed": 0, "parameters": {}}
    prior["parameters"]["trunk/m"] = {"value": 1.0, "std": 0.1}
    (tmp_path / "prior.json").write_text(json.dumps(prior))
    fails(symbid, "prior.json", "other", **good | {"prior": tmp_path / "prior.json"})


def test_neither_rank_nor_validation(symbid, good) -> None:
    good.pop("rank")
    fails(symbid, "--rank", "--validate", **good)


def test_a_log_too_short(symbid, good) -> None:
    fails(symbid, "too short", **good | {"cutoff": 0.05})


def test_a_topic_that_is_not_there(symbid, good) -> None:
    fails(symbid, "/absent", **good | {"imu_topic": "/absent"})


def test_a_topic_that_was_not_recorded(symbid, good, copied_without, tmp_path) -> None:
    bag = copied_without(good["bag"], tmp_path / "blind", "imu")
    fails(symbid, "blind", "Imu", **good | {"bag": bag})


def test_a_forgotten_force_plate(symbid, good, copied_without, tmp_path) -> None:
    """Its bag reads well, but the forces in it do not carry the robot."""
    bag = copied_without(good["bag"], tmp_path / "limping", "left_foot")
    fails(symbid, "limping", "right_sole", "% of the prior's weight", **good | {"bag": bag})


def test_what_was_there_stays(symbid, good) -> None:
    out = good["out"]
    out.mkdir()
    (out / "estimate.json").write_text("of yesterday")
    (out / "thesis.txt").write_text("years of work")
    bad = symbid("identify", "nowhere", "--model", good["model"], "--rank", 5, "--out", out)
    assert bad.returncode == 2
    assert (out / "estimate.json").read_text() == "of yesterday"
    written = symbid("identify", good["bag"], "--model", good["model"], "--rank", 5, "--out", out)
    assert written.returncode == 0
    assert (out / "thesis.txt").read_text() == "years of work"
    again = symbid("simulate", "--out", good["bag"])
    assert again.returncode == 2
    assert again.stderr.count("\n") == 1


def test_a_value_that_is_no_number(symbid, good, tmp_path) -> None:
    class Faulty(Simulator):
        def step(self):
            instant = super().step()
            if self._taken == 700:
                instant.joint_effort[2] = float("nan")
            return instant

    record(Faulty("smooth", moves=1, motion_seed=3), tmp_path / "faulty")
    fails(symbid, "joint_states", "R_kfe", **good | {"bag": tmp_path / "faulty"})


@pytest.mark.parametrize("columns", [40, 200])
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["identify", "log"], "Missing option '--model'; see `symbid identify --help`"),
        (["simulate", "--out", "bag", "--moves", 0], "'--moves'"),
        (["dance"], "No such command 'dance'; see `symbid --help`"),
    ],
)
def test_a_wrong_call_is_one_line_at_any_width(symbid, arguments, says, columns) -> None:
    ended = symbid(*arguments, columns=columns)
    assert ended.returncode == 2
    assert ended.stderr.startswith("symbid: ")
    assert ended.stderr.count("\n") == 1
    assert says in ended.stderr


def test_no_arguments_show_the_help(symbid) -> None:
    ended = symbid()
    assert ended.stderr == ""
    assert "identify" in ended.stdout
