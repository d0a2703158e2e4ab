"""Meaning of options, and protection of earlier results."""

import itertools
import re
import subprocess
import sys

import pytest
import typer.main

from symbid_ros.cli.app import app
from symbid_ros.package_paths import config_file


def commands(command, name="symbid"):
    """Return the words of every command that does something."""
    below = getattr(command, "commands", {})
    if not below:
        return [tuple(name.split())]
    return [words for key, one in below.items() for words in commands(one, f"{name} {key}")]


@pytest.mark.parametrize("words", commands(typer.main.get_command(app)), ids=" ".join)
def test_help_shows_no_value_beside_a_flag(symbid_here, words):
    shown = symbid_here(*words[1:], "--help")
    assert shown.returncode == 0
    assert "--help" in shown.stdout
    assert not re.search(r"<bool>|BOOL", shown.stdout)


def test_lines_of_help_are_filled(symbid_here):
    shown = symbid_here("simulate", "--help").stdout.splitlines()
    begin = next(i for i, line in enumerate(shown) if "With --trajectory, the robot" in line)
    lines = shown[begin : shown.index(" " * len(shown[0]), begin)]
    for line, below in itertools.pairwise(lines):
        assert len(line.rstrip()) + len(below.split()[0]) + 1 >= len(line) - 1


def test_a_simulated_bag_is_replaced_only_with_overwrite(symbid_here, tmp_path):
    bag = tmp_path / "bag"
    options = ("simulate", "--scenario", "tare", "--ideal", "--out", bag)
    bag.mkdir()
    (bag / "bag_0.mcap").write_bytes(b"of yesterday")
    refused = symbid_here(*options)
    assert refused.returncode == 2
    assert "give --overwrite to replace it" in refused.stderr
    assert [file.read_bytes() for file in bag.iterdir()] == [b"of yesterday"]
    (bag / "thesis.txt").write_text("years of work")
    assert "is not a bag; choose another --out" in symbid_here(*options, "--overwrite").stderr
    assert (bag / "thesis.txt").read_text() == "years of work"
    (bag / "thesis.txt").unlink()
    # Options are checked before anything is removed.
    assert symbid_here(*options, "--overwrite", "--errors", "none such").returncode == 2
    assert [file.read_bytes() for file in bag.iterdir()] == [b"of yesterday"]
    assert symbid_here(*options, "--overwrite").returncode == 0
    assert symbid_here("bag", "info", bag).returncode == 0


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "--out", "x" * 300),
        ("bag", "info", "x" * 300),
        ("bag", "doctor", "x" * 300),
        ("identify", "x" * 300, "--model", config_file("symbitron.urdf"), "--out", "out"),
        ("prior", "--model", "x" * 300, "--percent", 5, "--out", "prior.json"),
        ("study", "x" * 300 + ".yaml", "--out", "out"),
        ("demo", "--out", "x" * 300),
    ],
    ids=lambda words: words[0],
)
def test_a_name_too_long_for_the_file_system_is_one_line(symbid_here, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = symbid_here(*words)
    assert ended.returncode == 2
    assert ended.stderr.startswith("symbid: ")
    assert ended.stderr.count("\n") == 1
    assert "File name too long" in ended.stderr
    assert list(tmp_path.iterdir()) == []


# Sends SIGINT when a module begins to be imported, and runs the command.
INTERRUPTED = """
import os, signal, sys
module = sys.argv.pop(1)
def hook(event, arguments):
    if event == "import" and arguments[0] == module:
        os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(hook)
from symbid_ros.cli.main import main
main()
"""


@pytest.mark.parametrize("module", ["symbid_ros.cli.app", "typer", "numpy._core.multiarray"])
def test_ctrl_c_while_libraries_load_is_one_line(module, tmp_path):
    words = ("prior", "--model", config_file("symbitron.urdf"), "--percent", "5", "--out")
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, module, *words, tmp_path / "prior.json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "symbid: interrupted\n")
    assert list(tmp_path.iterdir()) == []
