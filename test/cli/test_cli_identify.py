"""`symbid prior`, `identify` and `evaluate` in a row, as a user runs them."""

import hashlib
import json
import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from json_schemas import require_valid

METRICS = {
    "gen_force_rmse",
    "torque_rmse",
    "com_position_rmse_mm",
    "com_momentum_rmse",
    "parameter_error_pct",
}
FILES = {"report_data.npz", "estimate.json", "information.npz", "model.urdf", "model.xml"}
WLS_RC = ("--method", "wls_rc", "--joint-terms", "none")


@pytest.fixture(scope="module")
def prior(symbid, model, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    ended = symbid("prior", "--model", model, "--percent", 25, "--seed", 3, "--out", path)
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


@pytest.fixture(scope="module")
def found(symbid_here, model, short, prior, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("found") / "out"
    identified(symbid_here, short, model, out, "--prior", prior)
    return out


@pytest.fixture(scope="module")
def truncated(symbid_here, model, short, ideal, prior, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("truncated") / "out"
    identified(
        symbid_here, short, model, out, "--prior", prior, *WLS_RC, "--choose-truncation", ideal
    )
    return out


@pytest.fixture(scope="module")
def before(symbid_here, model, ideal, prior) -> dict[str, float]:
    """Return what the prior itself is worth."""
    return evaluated(symbid_here, prior, model, ideal)


def identified(symbid, bag: Path, model: Path, out: Path, *options: object) -> dict[str, Any]:
    ended = symbid("identify", bag, "--model", model, *options, "--out", out)
    assert ended.returncode == 0
    # The truncated method leaves links that no mass density can realise.
    # A long path wraps the line anywhere.
    may_be_impossible = "wls_rc" in options and "the nearest" in " ".join(ended.stderr.split())
    assert ended.stderr.count("WARNING") == 2 * may_be_impossible  # one for each model file
    assert may_be_impossible or ended.stderr == ""
    assert {path.name for path in out.iterdir()} == FILES
    document = json.loads((out / "estimate.json").read_text())
    require_valid("estimate", document)
    return document


def evaluated(symbid, subject: Path, model: Path, bag: Path) -> dict[str, float]:
    ended = symbid("evaluate", subject, "--truth", model, "--bag", bag, "--json")
    assert (ended.returncode, ended.stderr) == (0, "")
    document = json.loads(ended.stdout)
    require_valid("evaluation", document)
    return document


def test_identification_beats_the_prior_on_every_metric(
    symbid_here, model, ideal, before, found
) -> None:
    after = evaluated(symbid_here, found, model, ideal)
    assert set(after) >= METRICS
    assert all(after[name] < before[name] for name in METRICS)


def test_without_options_links_are_possible_and_the_verdict_says_what_is_known(found) -> None:
    document = json.loads((found / "estimate.json").read_text())
    assert (document["method"], document["rank"]) == ("map_lmi", None)
    assert all(document["consistent"].values())
    parameters = document["parameters"]
    verdict = document["verdict"]
    # A biped that stands tells of its legs' and trunk's weight, hardly of the feet's inertia.
    determined = [name for name, entry in parameters.items() if entry["determined"]]
    assert 0 < len(determined) < len(parameters)
    assert 0 < verdict["effective"] < len(parameters)
    assert sum(quantity["determined"] for quantity in verdict["base"]) > 0
    assert verdict["alarms"] == []
    assert verdict["sensors"] == []


def test_the_estimate_names_its_inputs_command_options_and_versions(
    symbid_here, model, short, found, prior
) -> None:
    document = json.loads((found / "estimate.json").read_text())
    assert document["schema_version"] == 1
    provenance = document["provenance"]
    files = [*sorted(short.iterdir()), model, prior]
    assert provenance["inputs"] == [
        {
            "path": str(file),
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "size_bytes": file.stat().st_size,
        }
        for file in files
    ]
    words = shlex.split(provenance["command"])
    assert words[:3] == ["symbid", "identify", str(short)]
    options = provenance["options"]
    assert (options["prior"], options["base"]) == (str(prior), "auto")
    assert options.keys() >= {"method", "window", "start", "joint_terms"}
    assert provenance["versions"].keys() >= {"symbid_ros", "python", "numpy", "scipy", "clarabel"}
    assert datetime.fromisoformat(provenance["date"]) <= datetime.now(UTC)


def test_a_truncated_method_chooses_z_on_a_bag_or_by_itself(
    symbid_here, model, log, ideal, prior, before, truncated, tmp_path
) -> None:
    chosen = json.loads((truncated / "estimate.json").read_text())
    document = identified(symbid_here, log, model, tmp_path / "out", "--prior", prior, *WLS_RC)
    for each in (chosen, document):
        assert 1 <= each["rank"] < len(each["parameters"])
        assert each["verdict"] is None
    after = evaluated(symbid_here, tmp_path / "out", model, ideal)
    assert all(after[name] < before[name] for name in METRICS - {"parameter_error_pct"})


def test_a_run_continues_from_saved_information(
    symbid_here, model, log, found, prior, tmp_path
) -> None:
    earlier = json.loads((found / "estimate.json").read_text())
    both = identified(
        symbid_here,
        log,
        model,
        tmp_path / "out",
        *("--prior", prior, "--information", found),
        # The log begins with the earlier one's move.
        *("--window", earlier["verdict"]["window_s"], "--start", 7),
    )
    assert both["inputs"][-1] == str(found / "information.npz")
    assert both["samples"] > earlier["samples"]
    names = [name for name, entry in earlier["parameters"].items() if entry["determined"]]
    before, after = (
        np.array([document["parameters"][name]["std"] for name in names])
        for document in (earlier, both)
    )
    assert np.median(after / before) < 1


@pytest.mark.parametrize("part", [("--start", 2.5), ("--filter", "butterworth")])
def test_a_log_is_not_counted_twice(symbid_here, model, short, found, part, tmp_path) -> None:
    copy = tmp_path / "renamed"
    copy.symlink_to(short)
    ended = symbid_here(
        *("identify", copy, "--model", model, "--out", tmp_path / "out", *part),
        *("--information", found / "information.npz"),
    )
    assert ended.returncode == 2
    assert "counted twice" in ended.stderr
    assert "leave --information out" in ended.stderr
    assert not (tmp_path / "out").exists()


def test_the_equation_of_motion_closes_on_an_ideal_bag(symbid_here, model, ideal, tmp_path) -> None:
    exact = tmp_path / "exact.json"
    symbid_here("prior", "--model", model, "--percent", 1e-9, "--seed", 0, "--out", exact)
    metrics = evaluated(symbid_here, exact, model, ideal)
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


@pytest.mark.parametrize("kind", ["found", "truncated"])
def test_ground_truth_does_not_affect_an_estimate(
    symbid_here, model, short, ideal, prior, kind, copied_without, request, tmp_path
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
    copied_without(short, elsewhere / short.name, "ground_truth")
    options: tuple[object, ...] = ("--prior", prior)
    if kind == "truncated":
        copied_without(ideal, elsewhere / ideal.name, "ground_truth")
        options += (*WLS_RC, "--choose-truncation", elsewhere / ideal.name)
    blind = identified(
        symbid_here, elsewhere / short.name, elsewhere / model.name, tmp_path / "out", *options
    )
    found = request.getfixturevalue(kind)
    expected = json.loads((found / "estimate.json").read_text())
    for names_files in ("inputs", "provenance"):
        assert expected.pop(names_files) != blind.pop(names_files)
    assert blind == expected
    with (
        np.load(found / "information.npz") as one,
        np.load(tmp_path / "out" / "information.npz") as other,
    ):
        assert set(one) == set(other)
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


def test_a_log_in_degrees_is_refused_with_the_doctors_line(
    symbid_here, model, short, tmp_path
) -> None:
    def degrees(messages: Messages) -> None:
        for name in ("position", "velocity"):
            messages.records[name] *= 180 / np.pi

    bag = edit_bag(short, tmp_path / "bag", {"/joint_states": degrees})
    judged = symbid_here("bag", "doctor", bag, "--model", model, "--json")
    assert judged.returncode == 2
    (line,) = [
        one["message"] for one in json.loads(judged.stdout)["findings"] if one["kind"] == "unit"
    ]
    ended = symbid_here("identify", bag, "--model", model, "--out", tmp_path / "out")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith(f"symbid: {bag}: {line}")
    assert "--unchecked" in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_alarms_come_first_and_end_with_status_1(
    symbid_here, model, short, prior, tmp_path
) -> None:
    certain = json.loads(prior.read_text())
    for entry in certain["parameters"].values():
        entry["std"] /= 50
    (tmp_path / "certain.json").write_text(json.dumps(certain))
    out = tmp_path / "out"
    ended = symbid_here(
        *("identify", short, "--model", model, "--prior", tmp_path / "certain.json"),
        *("--joint-terms", "none", "--out", out),
    )
    assert ended.returncode == 1
    assert {path.name for path in out.iterdir()} == FILES
    alarms = json.loads((out / "estimate.json").read_text())["verdict"]["alarms"]
    assert alarms
    lines = ended.stdout.splitlines()
    assert lines[: len(alarms)] == [f"alarm: {alarm}" for alarm in alarms]
    assert lines[-1].startswith("wrote ")


def test_the_doctors_warnings_are_given_before_the_estimate(
    symbid_here, model, short, tmp_path
) -> None:
    """A joint without effort costs its own row; the log is identified all the same."""

    def spoil(messages: Messages) -> None:
        messages.records["effort"][:, messages.joints.index("L_kfe")] = np.nan

    bag = edit_bag(short, tmp_path / "bag", {"/joint_states": spoil})
    out = tmp_path / "out"
    quick = ("--prior-percent", 25, "--joint-terms", "none", "--no-holdout")
    ended = symbid_here("identify", bag, "--model", model, *quick, "--out", out)
    assert ended.returncode == 0
    assert "effort of L_kfe is in no message" in " ".join(ended.stderr.split())
    assert ended.stderr.count("L_kfe") == 1
    residuals = json.loads((out / "estimate.json").read_text())["residual_rmse"]
    assert "L_kfe" not in residuals
    assert {"R_kfe", "L_hfe", "base/force_z"} <= set(residuals)
