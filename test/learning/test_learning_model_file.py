"""A live model passes through a file, and a controller judges it as one from topics."""

import json
from dataclasses import replace

import numpy as np
import pytest
from json_schemas import require_valid

from symbid_ros.errors import DataError
from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.learning import model_file
from symbid_ros.learning.model_file import ModelFile, read_model, write_model
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.standing_controller import StandingController


@pytest.fixture(scope="module")
def known() -> CandidateModel:
    model = load_model(config_file("symbitron.xml"))
    std = 0.01 * np.ones_like(model.phi)
    return CandidateModel(
        model.link_names, model.phi, std, ("a", "b"), mass_std=0.1, com_std=0.015, change="heavier"
    )


def test_a_model_is_read_as_it_was_written(tmp_path, known) -> None:
    path = tmp_path / "live.json"
    unknown = replace(known, std=np.full_like(known.std, np.nan), mass_std=None, com_std=None)
    for candidate in (known, unknown):
        write_model(path, candidate, 12.5)
        require_valid("live_model", json.loads(path.read_text()))
        found, until = read_model(path)
        assert until == 12.5
        assert (found.links, found.alarms, found.change) == (known.links, ("a", "b"), "heavier")
        assert (found.mass_std, found.com_std) == (candidate.mass_std, candidate.com_std)
        np.testing.assert_array_equal(found.phi, candidate.phi)
        np.testing.assert_array_equal(found.std, candidate.std)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("schema_version", 2),
        ("links", {"body": {"phi": [1.0], "std": [1.0]}}),
        ("links", {"body": {"phi": ["1"] * 10, "std": [1.0] * 10}}),
        ("links", [1]),
        ("alarms", None),
        ("until_s", "now"),
        ("mass_std_kg", True),
    ],
)
def test_another_document_is_refused_in_one_line(tmp_path, known, key, value) -> None:
    path = tmp_path / "live.json"
    write_model(path, known, 1.0)
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(DataError, match="not the file of an identifier") as caught:
        read_model(path)
    assert "\n" not in str(caught.value)


def test_a_controller_takes_models_from_the_file(tmp_path, known, monkeypatch) -> None:
    monkeypatch.setattr(model_file, "POLL", 0.0)
    path, lines = tmp_path / "live.json", []
    source = ModelFile(path, StandingController(is_cautious=True), 0.25, lines.append)

    def said() -> list[str]:
        lines.clear()
        source.update()
        return list(lines)

    assert said() == []  # the file does not exist yet
    path.write_text("{}")
    (line,) = said()
    assert "has no 'schema_version'" in line
    write_model(path, replace(known, change=""), 2.0)
    assert said() == ["the identified model is not used: alarm: a"]
    assert said() == []  # the same file
    nothing = replace(known, phi=0.0 * known.phi, alarms=(), change="")
    write_model(path, nothing, 3.0)
    (line,) = said()
    assert "the masses sum to 0 kg" in line
    write_model(path, replace(known, alarms=(), change=""), 4.0)
    (line,) = said()
    assert line.startswith("model identified until 4.000 s replaces the present one; moves have ")
    write_model(path, replace(known, alarms=()), 5.0)
    assert said() == ["the model is withdrawn: heavier"]
    assert source.counts == {"accepted": 1, "refused": 2, "withdrawn": 1}


def test_a_place_without_a_folder_is_refused_at_once(tmp_path) -> None:
    for path in (tmp_path / "absent" / "live.json", tmp_path):
        with pytest.raises(DataError, match="name the file that the identifier writes"):
            ModelFile(path, StandingController(), 0.25, print)
