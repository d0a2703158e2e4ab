"""`symbid prior`, `identify` and `evaluate` in a row, as a user runs them."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

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
    text = (found / "model.urdf").read_text()
    masses = [float(mass) for mass in re.findall(r'<mass value="([^"]+)"', text)]
    assert sum(masses) == pytest.approx(total, rel=1e-9)
    if all(document["consistent"].values()):
        written = mujoco.MjModel.from_xml_path(str(found / "model.xml"))
        assert written.body_mass.sum() == pytest.approx(total, rel=1e-9)


def sensors_only(bag: Path, copy: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with (
        AnyReader([bag], default_typestore=store) as reader,
        Writer(copy, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        kept = [c for c in reader.connections if "ground_truth" not in c.topic]
        assert len(kept) < len(reader.connections)
        to = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in kept}
        for connection, time, data in reader.messages(kept):
            writer.write(to[connection.id], time, data)


def test_no_truth_leaks_into_an_estimate(symbid, model, log, ideal, prior, found, tmp_path) -> None:
    """With a prior file neither the model's inertias nor the ground truth are looked at."""
    rng = np.random.default_rng(0)
    text = model.read_text()
    randomised = re.sub(
        r'mass="([^"]+)"', lambda found: f'mass="{float(found[1]) * rng.uniform(0.3, 3)}"', text
    )
    randomised = re.sub(
        r'fullinertia="([^"]+)"',
        lambda found: (
            'fullinertia="' + " ".join(str(float(each) * 1.7) for each in found[1].split()) + '"'
        ),
        randomised,
    )
    assert randomised != text
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / model.name).write_text(randomised)
    for bag in (log, ideal):
        sensors_only(bag, elsewhere / bag.name)
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
