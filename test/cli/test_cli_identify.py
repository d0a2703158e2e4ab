"""`symbid prior`, `identify` and `evaluate` in a row, as a user runs them."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

METRICS = {
    "gen_force_rmse",
    "torque_rmse",
    "com_position_rmse_mm",
    "com_momentum_rmse",
    "parameter_error_pct",
}


@pytest.fixture(scope="module")
def prior(symbid, model, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    ended = symbid("prior", "--model", model, "--percent", 25, "--seed", 3, "--out", path)
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


@pytest.fixture(scope="module")
def found(symbid, model, log, ideal, prior, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("found") / "out"
    ended = symbid(
        "identify", log, "--model", model, "--prior", prior, "--validate", ideal, "--out", out
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    return out


def evaluated(symbid, subject: Path, model: Path, bag: Path, out: Path) -> dict[str, float]:
    ended = symbid("evaluate", subject, "--model", model, "--bag", bag, "--json", out)
    assert (ended.returncode, ended.stderr) == (0, "")
    return json.loads(out.read_text())


def test_identification_beats_the_prior_on_every_metric(
    symbid, model, ideal, prior, found, tmp_path
) -> None:
    before = evaluated(symbid, prior, model, ideal, tmp_path / "before.json")
    after = evaluated(symbid, found, model, ideal, tmp_path / "after.json")
    assert set(after) >= METRICS
    assert all(after[name] < before[name] for name in METRICS)


def test_the_equation_of_motion_closes_on_an_ideal_bag(symbid, model, ideal, tmp_path) -> None:
    exact = tmp_path / "exact.json"
    symbid("prior", "--model", model, "--percent", 1e-9, "--seed", 0, "--out", exact)
    metrics = evaluated(symbid, exact, model, ideal, tmp_path / "metrics.json")
    assert metrics["gen_force_rmse"] <= 1e-3
    assert metrics["com_position_rmse_mm"] <= 1e-6


def test_written_models_hold_the_estimate(found) -> None:
    document = json.loads((found / "estimate.json").read_text())
    total = sum(
        entry["value"] for name, entry in document["parameters"].items() if name.endswith("/m")
    )
    urdf = ElementTree.parse(found / "model.urdf").iter("mass")
    mjcf = ElementTree.parse(found / "model.xml").iter("inertial")
    assert sum(float(mass.attrib["value"]) for mass in urdf) == pytest.approx(total, rel=1e-9)
    assert sum(float(each.attrib["mass"]) for each in mjcf) == pytest.approx(total, rel=1e-9)


def test_no_truth_leaks_into_an_estimate(
    symbid, model, log, ideal, prior, found, copied_without, tmp_path
) -> None:
    """With a prior file neither the model's inertias nor the ground truth are looked at."""
    rng = np.random.default_rng(0)
    tree = ElementTree.parse(model)
    inertials = list(tree.iter("inertial"))
    assert len(inertials) == 11
    for inertial in inertials:
        scale = rng.uniform(0.3, 3)
        shift = rng.normal(scale=0.05, size=3)
        for name, values in {
            "pos": np.array(inertial.attrib["pos"].split(), float) + shift,
            "mass": [scale * float(inertial.attrib["mass"])],
            "fullinertia": scale * np.array(inertial.attrib["fullinertia"].split(), float),
        }.items():
            inertial.set(name, " ".join(map(str, values)))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    tree.write(elsewhere / model.name)
    for bag in (log, ideal):
        copied_without(bag, elsewhere / bag.name, "ground_truth")
    ended = symbid(
        "identify",
        elsewhere / log.name,
        "--model",
        elsewhere / model.name,
        "--prior",
        prior,
        "--validate",
        elsewhere / ideal.name,
        "--out",
        tmp_path / "out",
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    expected = json.loads((found / "estimate.json").read_text())
    blind = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert expected.pop("inputs") != blind.pop("inputs")
    assert blind == expected
