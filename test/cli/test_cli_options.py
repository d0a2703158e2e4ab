"""Meaning of options, and protection of earlier results."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from symbid_ros.cli.app import _command, app
from symbid_ros.package_paths import config_file
from symbid_ros.report.templates import is_page, page_template


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


def test_each_command_has_a_table_of_its_options_in_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "options.md").read_text()
    names = [" ".join(words[1:]) for words in commands(typer.main.get_command(app))]
    assert [name for name in names if f"```{{options}} {name}\n" not in page] == []


@pytest.mark.parametrize("words", commands(typer.main.get_command(app)), ids=" ".join)
def test_help_has_frames_on_a_terminal_of_usual_width(symbid_here, words):
    assert "╭─ Options" in symbid_here(*words[1:], "--help", columns=80).stdout


@pytest.mark.parametrize("columns", [60, 79, 80, 100])
@pytest.mark.parametrize("words", commands(typer.main.get_command(app)), ids=" ".join)
def test_help_suits_the_terminal(symbid_here, words, columns):
    """No name is cut off, no word of a choice broken, no markup or Python type shown."""
    shown = symbid_here(*words[1:], "--help", columns=columns).stdout
    assert max(map(len, shown.splitlines())) <= columns
    assert "…" not in shown
    assert not re.search(r"\[/?b\]|<str>|<int[ >]|<float|list\[", shown)
    assert not re.search(r"<[a-z_]+\|[^>\n]*\n", shown)


@pytest.mark.parametrize("words", commands(typer.main.get_command(app)), ids=" ".join)
def test_help_tells_defaults_and_what_is_repeatable(words):
    command = _command()
    for word in words[1:]:
        command = command.commands[word]
    for option in command.params:
        if option.param_type_name == "option" and option.multiple:
            assert "Repeatable." in option.help, option.name
        is_number = isinstance(option.default, int | float) and not option.is_flag
        if is_number and option.name != "verbose":
            assert option.show_default, option.name


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
    # A simulation that fails leaves the earlier bag as well.
    fallen = ("simulate", "--moves", 1, "--payload-mass", 100, "--out", bag, "--overwrite")
    assert "SYMBID-E613" in symbid_here(*fallen).stderr
    assert [file.read_bytes() for file in bag.iterdir()] == [b"of yesterday"]
    assert symbid_here(*options, "--overwrite").returncode == 0
    assert symbid_here("bag", "info", bag).returncode == 0
    assert list(tmp_path.iterdir()) == [bag]


URDF = config_file("symbitron.urdf")


@pytest.mark.parametrize(
    "words",
    [
        ("prior", "--model", URDF, "--percent", 5, "--out"),
        ("report", "result", "--out"),
        ("fleet", "a", "b", "c", "--out"),
        ("simulate", "--moves", 1, "--out", "bag", "--true-model"),
        ("init", "--model", URDF, "--foxglove"),
        ("apply", "result", "--xacro-yaml"),
    ],
    ids=lambda words: words[0],
)
def test_a_file_of_something_else_stays_and_no_work_is_done(
    symbid_here, words, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.urdf").write_text("years of work")
    ended = symbid_here(*words, "robot.urdf")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "robot.urdf: exists; choose another name, or" in ended.stderr
    assert "SYMBID-E551" in ended.stderr
    assert (tmp_path / "robot.urdf").read_text() == "years of work"
    (tmp_path / "folder").mkdir()
    assert "is a folder; name a file in it" in symbid_here(*words, "folder").stderr
    assert {path.name for path in tmp_path.iterdir()} == {"robot.urdf", "folder"}


def test_a_command_that_is_repeated_replaces_its_output(symbid_here, tmp_path):
    prior = ("prior", "--model", URDF, "--percent", 5, "--out", tmp_path / "prior.json")
    simulate = ("simulate", "--scenario", "tare", "--ideal", "--overwrite")
    simulate += ("--out", tmp_path / "bag", "--true-model", tmp_path / "truth.xml")
    for words in (prior, simulate) * 2:
        ended = symbid_here(*words)
        assert ended.returncode == 0, ended.stderr
    page = tmp_path / "report.html"
    page.write_text(page_template("page_base.html").render(title="Robot", css=""))
    assert is_page(page)
    page.write_text("<html></html>")
    assert not is_page(page)


@pytest.mark.parametrize(
    "words",
    [
        ("init", "--model", URDF, "--bag", "bag", "--out", "new", "--foxglove", "./new"),
        ("init", "--model", "new", "--bag", "bag", "--out", "new", "--overwrite"),
        ("apply", "result", "robot", "--out", "new", "--xacro-yaml", "./new"),
        ("apply", "result", "new", "--out", "./new", "--overwrite"),
        ("simulate", "--out", "new", "--true-model", "./new"),
    ],
    ids=lambda words: " ".join(map(str, words[-3:])),
)
def test_one_file_for_two_outputs_is_refused(symbid_here, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = symbid_here(*words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "are the same file; name different ones (SYMBID-E502)" in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ("bag", "info", ""),
        ("bag", "recover", ""),
        ("bag", "doctor", "bag", ""),
        ("prior", "--model", URDF, "--percent", "5", "--out", ""),
        ("identify", "bag", "--model", URDF, "--out="),
        ("identify", "bag", "--model", URDF, "--out", "out", "--information", ""),
        ("evaluate", "result", "--truth", URDF, "--bag", "bag", "--bag", ""),
        ("live", ""),
    ],
    ids=lambda words: " ".join(map(str, words[:2])),
)
def test_an_empty_path_is_refused(symbid_here, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = symbid_here(*words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert "empty path; name a file or folder" in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_has_a_code(symbid_here, tmp_path):
    (tmp_path / "file").write_text("")
    ended = symbid_here("demo", "--out", tmp_path / "file" / "demo")
    assert (ended.returncode, "(SYMBID-E552)" in ended.stderr) == (2, True)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("words", [("--version",), ("prior", "--help")], ids=" ".join)
def test_a_full_disk_behind_the_output_is_one_line(words):
    with open("/dev/full", "w") as full:
        ended = run_process(*words, stdout=full)
    assert ended.returncode == 2
    assert ended.stderr.startswith("symbid: standard output: cannot write (")
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize("words", [("--version",), ("prior", "--help")], ids=" ".join)
def test_a_closed_pipe_ends_a_command_silently(words):
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as pipe:
        ended = run_process(*words, stdout=pipe)
    assert (ended.returncode, ended.stderr) == (141, "")


def run_process(*words, stdout):
    return subprocess.run(
        [sys.executable, "-m", "symbid_ros.cli.main", *words],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )


def test_loading_the_simulator_starts_no_process(tmp_path):
    """A child would print a traceback after Ctrl-C."""
    program = """
import sys
from pathlib import Path
from symbid_ros.cli.main import main
sys.addaudithook(lambda event, _: event == "subprocess.Popen" and sys.stderr.write("a process\\n"))
main()
"""
    ended = subprocess.run(
        [
            *(sys.executable, "-c", program, "simulate"),
            *("--moves", "1", "--payload-mass", "100", "--out", tmp_path / "bag"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "SYMBID-E613" in ended.stderr
    assert "a process" not in ended.stderr


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
