"""The rehearsals on the page of excitation run as they are shown, with a shorter search."""

import json
import re
import shlex
import shutil
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pytest
from documented_robots import ur5_urdf, write_inaccurate

from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

PAGE = Path(__file__).resolve().parents[2] / "docs" / "excitation.md"
SHORT = ("--starts", "1", "--iterations", "6", "--seconds", "10")


def shown_commands(model: str) -> list[list[str]]:
    """Return the words of the commands for a model file, and of those on their results."""
    lines = re.findall(r"^(?:\$ )?symbid (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    stem = model.removesuffix(".urdf")
    others = {"anymal", "solo12", "symbitron"} - {stem}
    named = [line for line in lines if not any(other in line for other in others)]
    return [shlex.split(line) for line in named if stem == "my_arm" or stem in line]


def write_model(name: str, folder: Path) -> None:
    if name == "my_arm.urdf":
        write_inaccurate(ur5_urdf(), folder / name, seed=4)
        return
    found = (each for each in files("example-robot-data") or () if each.name == name)
    shutil.copy(next(str(each.locate()) for each in found), folder / name)


@pytest.mark.parametrize(
    ("model", "result", "truth", "count"),
    [
        ("my_arm.urdf", "rehearsed", "rehearsal_truth.xml", 7),
        ("anymal.urdf", "anymal_rehearsed", "anymal_rehearsal_truth.xml", 7),
    ],
)
def test_a_shown_rehearsal_finds_the_true_robot(
    symbid_here, tmp_path, monkeypatch, model, result, truth, count
):
    monkeypatch.chdir(tmp_path)
    write_model(model, tmp_path)
    shown = shown_commands(model)
    assert len(shown) == count
    for words in shown:
        ended = symbid_here(*words, *(SHORT if words[0] == "excite" else ()))
        assert ended.returncode == 0, (words, ended.stdout, ended.stderr)
    true = ParameterSet(load_model(truth), ("viscous", "coulomb", "armature"))
    exact = dict(zip(true.names, true.values.tolist(), strict=True))
    estimate = json.loads(Path(result, "estimate.json").read_text())["parameters"]
    scores = [
        (each["value"] - exact[name]) / each["std"]
        for name, each in estimate.items()
        if each["determined"] and name in exact
    ]
    assert len(scores) > 40
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.5
