"""Provenance: checksums of inputs, options as JSON values, versions."""

import hashlib
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np

from symbid_ros.estimation.provenance import (
    InputDigests,
    InputFile,
    Provenance,
    command_line,
    digest,
    library_versions,
    list_inputs,
    option_values,
)
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.package_paths import package_version


def test_checksums_are_those_of_sha256sum(tmp_path):
    large = tmp_path / "bag_0.mcap"
    large.write_bytes(np.random.default_rng(1).bytes(3_000_001))
    (tmp_path / "metadata.yaml").write_text("")
    found = InputDigests([tmp_path]).wait()
    told = subprocess.run(
        ["sha256sum", large, tmp_path / "metadata.yaml"], capture_output=True, text=True, check=True
    )
    assert [f"{one.sha256}  {one.path}" for one in found] == told.stdout.splitlines()
    assert [one.size_bytes for one in found] == [3_000_001, 0]


def test_folders_stand_for_their_visible_files_and_each_file_counts_once(tmp_path):
    for name in ("b.mcap", "a.mcap", ".hidden"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder").mkdir()
    named = [tmp_path / "a.mcap", tmp_path, tmp_path / "missing.urdf"]
    assert [path.name for path in list_inputs(named)] == ["a.mcap", "b.mcap"]


def test_a_file_that_vanished_has_no_checksum(tmp_path):
    assert digest(tmp_path / "gone") == InputFile(str(tmp_path / "gone"), None, None)


def test_options_are_json_values_of_all_options():
    options = IdentifyOptions(
        prior=Path("prior.json"), prior_percent=None, joint_terms=("viscous", "offset")
    )
    values = option_values(options)
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["prior"] == "prior.json"
    assert values["joint_terms"] == ["viscous", "offset"]
    assert values["prior_percent"] is None
    assert values["method"] == "map_lmi"


def test_a_front_end_adds_its_command_files_and_options(tmp_path):
    robot = tmp_path / "robot.yaml"
    robot.write_bytes(b"/**: {}\n")
    found = Provenance.now((), IdentifyOptions()).extended("symbid x", [robot], {"start": 2.0})
    checksum = hashlib.sha256(b"/**: {}\n").hexdigest()
    assert found.inputs == (InputFile(str(robot), checksum, 8),)
    assert found.command == "symbid x"
    assert found.options["start"] == 2.0
    assert found.options["method"] == "map_lmi"
    assert found.date.endswith("+00:00")


def test_versions_name_loaded_libraries_alone(monkeypatch):
    assert library_versions()["numpy"] == np.__version__
    assert library_versions()["symbid_ros"] == package_version()
    monkeypatch.delitem(sys.modules, "numpy")
    assert "numpy" not in library_versions()


def test_the_command_can_be_pasted_into_a_shell(monkeypatch):
    words = ["symbid", "identify", "my bag", "--model", "it's.urdf"]
    monkeypatch.setattr(sys, "argv", ["/opt/bin/symbid", *words[1:]])
    assert shlex.split(command_line()) == words
