"""estimate.json: what is written is read again, and damaged files are named."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from expected_errors import raises_code

from symbid_ros.estimation.estimate import Estimate, HoldOut, RowSettings, mass_text
from symbid_ros.estimation.estimate_file import estimate_document, load_estimate, write_estimate
from symbid_ros.estimation.provenance import InputFile, Provenance
from symbid_ros.estimation.unexplained import UnexplainedForce
from symbid_ros.estimation.verdict import EstimatedQuantity, Verdict
from symbid_ros.json_documents import VERSIONS

VERDICT = Verdict(
    window=0.161,
    prior_scale=1.25,
    whiteness=0.9,
    noise_share=0.1,
    alarms=("the residuals are not white noise",),
    effective=2.5,
    gain=7.5,
    link_gain={"base": 5.0, "leg": 2.5},
    directions=("base/m", "leg/m"),
    base=(EstimatedQuantity("base/m + leg/m", "kg", 3.0, 0.1, True),),
    sensors=(EstimatedQuantity("sole/wrench_offset", "N", -1.0, 2.0, False),),
    unexplained=(UnexplainedForce("knee", "Nm", 3.0, 80.0, 0.0375),),
)
ESTIMATE = Estimate(
    method="map_lmi",
    model="hopper",
    names=("base/m", "leg/m", "knee/viscous"),
    units=("kg", "kg", "Nm s/rad"),
    value=np.array([2.0, 1.0, 0.1]),
    prior=np.array([2.5, 0.5, 0.0]),
    std=np.array([0.1, 0.2, 0.3]),
    determined=np.array([True, False, True]),
    rank=None,
    condition=12.5,
    samples=400,
    residual_rmse={"base/moment_x": 0.5, "knee": 0.25},
    consistent={"base": True, "leg": False},
    inputs=("bag", "hopper.urdf"),
    software="symbid_ros 0.1",
    verdict=VERDICT,
    known={"knee/coulomb": 0.75},
    rows=RowSettings("weak", window=0.161, rate=250.0),
    holdout=HoldOut(12.0, 9.4, 1.2, "better", 0.5, {"knee": (0.5, 0.1)}, "9.4 % → 1.2 %"),
    provenance=Provenance(
        inputs=(InputFile("bag/bag_0.mcap", "ab" * 32, 12), InputFile("gone.urdf", None, None)),
        command="symbid identify bag --model gone.urdf",
        options={"method": "map_lmi", "tare": [], "prior_percent": None},
        versions={"symbid_ros": "0.1.0"},
        date="2026-03-01T12:00:00+00:00",
    ),
)
EARLIER_KEYS = {
    "verdict": {"window_s": "window", "gain_bits": "gain", "link_gain_bits": "link_gain"},
    "rows": {"window_s": "window", "cutoff_hz": "cutoff"},
    "holdout": {"duration_s": "seconds"},
}
TRUNCATED = replace(ESTIMATE, std=None, determined=None, verdict=None, rank=2, known={})


@pytest.mark.parametrize("estimate", [ESTIMATE, TRUNCATED], ids=["map", "truncated"])
def test_an_estimate_is_read_as_it_was_written(estimate, tmp_path):
    write_estimate(tmp_path / "estimate.json", estimate)
    found = load_estimate(tmp_path / "estimate.json")
    for field in fields(Estimate):
        value, expected = getattr(found, field.name), getattr(estimate, field.name)
        np.testing.assert_array_equal(value, expected)
        assert type(value) is type(expected)


def test_files_without_unexplained_forces_are_read(tmp_path):
    """Earlier versions did not write them."""
    path = tmp_path / "estimate.json"
    write_estimate(path, ESTIMATE)
    document = json.loads(path.read_text())
    del document["verdict"]["unexplained"]
    path.write_text(json.dumps(document))
    assert load_estimate(path).verdict == replace(VERDICT, unexplained=())


def test_files_without_provenance_are_read(tmp_path):
    """Earlier versions wrote neither it nor a schema_version, and no units in keys."""
    path = tmp_path / "estimate.json"
    write_estimate(path, ESTIMATE)
    document = json.loads(path.read_text())
    assert document.pop("schema_version") == VERSIONS["estimate"]
    del document["provenance"]
    for name, keys in EARLIER_KEYS.items():
        for key, earlier in keys.items():
            document[name][earlier] = document[name].pop(key)
    path.write_text(json.dumps(document))
    found = load_estimate(path)
    assert found.provenance is None
    assert (found.verdict, found.rows, found.holdout) == (VERDICT, ESTIMATE.rows, ESTIMATE.holdout)


def test_files_of_a_later_release_are_refused(tmp_path):
    path = tmp_path / "estimate.json"
    write_estimate(path, ESTIMATE)
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"schema_version": VERSIONS["estimate"] + 1}))
    with raises_code("E475", "update symbid_ros"):
        load_estimate(path)


def test_the_file_has_one_entry_for_each_parameter(tmp_path):
    path = tmp_path / "estimate.json"
    write_estimate(path, ESTIMATE)
    assert path.read_text().endswith("}\n")
    assert '\n "method": "map_lmi",\n' in path.read_text()
    document = json.loads(path.read_text())
    assert list(document["parameters"]) == ["base/m", "leg/m", "knee/viscous"]
    assert document["parameters"]["leg/m"] == {
        "value": 1.0,
        "std": 0.2,
        "prior": 0.5,
        "unit": "kg",
        "determined": False,
    }
    write_estimate(path, TRUNCATED)
    document = json.loads(path.read_text())
    assert document["parameters"]["leg/m"]["std"] is None
    assert document["parameters"]["leg/m"]["determined"] is None
    assert document["verdict"] is None


def without(*path):
    """Return a change of a document that removes an entry."""

    def change(document):
        for key in path[:-1]:
            document = document[key]
        del document[path[-1]]

    return change


def with_entry(value, *path):
    """Return a change of a document that sets an entry."""

    def change(document):
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (without("method"), "method"),
        (without("parameters", "leg/m", "std"), "std"),
        (without("verdict", "alarms"), "alarms"),
        (with_entry("much", "parameters", "leg/m", "value"), "much"),
        (with_entry(3, "parameters"), "values"),
        (with_entry(1, "verdict", "unknown"), "unknown"),
        (with_entry([{"name": "base/m"}], "verdict", "base"), "unit"),
        (with_entry({"inputs": [], "options": [1]}, "provenance"), "options are not a mapping"),
        (with_entry(None, "parameters", "leg/m", "value"), "value of leg/m is not finite"),
        (
            with_entry(float("inf"), "parameters", "base/m", "prior"),
            "prior of base/m is not finite",
        ),
        (with_entry(float("nan"), "known", "knee/coulomb"), "known"),
    ],
)
def test_a_damaged_estimate_is_named(change, names, tmp_path):
    path = tmp_path / "estimate.json"
    document = estimate_document(ESTIMATE)
    change(document)
    path.write_text(json.dumps(document))
    with raises_code("E409", rf"estimate\.json: .*{names}"):
        load_estimate(path)


def test_files_of_earlier_versions_lack_known_terms(tmp_path):
    path = tmp_path / "estimate.json"
    document = estimate_document(ESTIMATE)
    del document["known"]
    path.write_text(json.dumps(document))
    assert load_estimate(path).known == {}


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "estimate.json"
    with raises_code("E401", "there is no estimate.json; give the folder"):
        load_estimate(path)
    path.write_text("{")
    with raises_code("E409", r"estimate\.json"):
        load_estimate(path)


def test_a_fixed_base_is_not_asked_for_its_total_mass() -> None:
    verdict = replace(VERDICT, mass_scale=0.01, sensors=())
    assert "`total_mass`" in verdict.describe_mass_scale()
    fixed = verdict.describe_mass_scale(floating=False)
    assert fixed.startswith("mass scale ± 1 %")
    assert "`total_mass`" not in fixed
    assert "give the standard deviation of their common gain error as `force_scale_std`" in fixed
    stated = replace(verdict, is_scale_stated=True)
    assert "give" not in stated.describe_mass_scale(floating=False)
    assert "give `total_mass` to check it" in stated.describe_mass_scale()


def test_a_weighing_that_does_not_check_the_scale_says_how_uncertain_it_is() -> None:
    verdict = replace(VERDICT, mass_scale=0.01, weighing_std=0.5, sensors=())
    assert "weighing with a standard deviation of 0.5 kg" in verdict.describe_mass_scale()
    assert "give `total_mass`," not in verdict.describe_mass_scale()
    alarm = "the weighing of 30.00 ± 0.1 kg contradicts the data, which say 41.07 ± 0.2 kg"
    assert replace(verdict, alarms=(alarm,)).describe_mass_scale() == ""


def test_masses_are_to_the_gram_or_to_two_digits_of_their_deviation():
    assert mass_text(1.70004, 0.0163) == "1.700 ± 0.016"
    assert mass_text(24.0, 1.25) == "24.000 ± 1.250"
    assert mass_text(0.0123, 4e-5) == "0.012300 ± 0.000040"
    assert mass_text(1.7, None) == mass_text(1.7, 0.0) == "1.700"
