"""`symbid evaluate` with and without a noisy bag."""

import json
from dataclasses import fields

import pytest

from symbid_ros.offline.evaluation import Metrics
from symbid_ros.offline.prediction import RealisticMetrics


@pytest.fixture(scope="module")
def prior(symbid, model, tmp_path_factory):
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    ended = symbid("prior", "--model", model, "--percent", 25, "--seed", 3, "--out", path)
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


def test_realistic_predictions_come_beside_the_ideal_ones(
    symbid, model, log, ideal, prior, tmp_path
) -> None:
    plain, both = tmp_path / "plain.json", tmp_path / "both.json"
    command = ("evaluate", prior, "--model", model, "--bag", ideal)
    ended = symbid(*command, "--json", plain)
    assert "from noisy sensors" not in ended.stdout
    ended = symbid(*command, "--realistic", log, "--json", both)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "from noisy sensors" in ended.stdout
    figures = json.loads(both.read_text())
    realistic = figures.pop("realistic")
    assert figures == json.loads(plain.read_text())
    assert set(figures) == {field.name for field in fields(Metrics)}
    assert set(realistic) == {field.name for field in fields(RealisticMetrics)}
    assert all(f"{value:.4g}" in ended.stdout for value in realistic.values())


def test_what_cannot_be_predicted_from_is_refused_in_one_line(
    symbid, model, log, ideal, prior, copied_without, tmp_path
) -> None:
    command = ("evaluate", prior, "--model", model, "--bag", ideal, "--realistic")
    no_imu = copied_without(log, tmp_path / "bag", "imu")
    for options, named in (((no_imu,), "Imu"), ((log, "--velocity-cutoff", 900), "cutoff 900 Hz")):
        ended = symbid(*command, *options)
        assert ended.returncode == 2
        assert named in ended.stderr
        assert ended.stderr.count("\n") == 1
