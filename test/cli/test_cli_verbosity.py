"""Flags that every command has, progress on terminals, and completion in shells."""

import os
import pty
import select
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from symbid_ros.cli.app import app
from symbid_ros.cli.verbosity import logged_level
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.progress import report, reported_to

SYMBID = Path(sys.executable).parent / "symbid"
DEADLINE = 300.0  # s; only a hang takes longer


def commands(command, name="symbid"):
    """Return the words of every command and group."""
    below = getattr(command, "commands", {})
    return [
        tuple(name.split()),
        *(words for key, one in below.items() for words in commands(one, f"{name} {key}")),
    ]


@pytest.mark.parametrize("words", commands(typer.main.get_command(app)), ids=" ".join)
def test_every_command_has_short_flags(symbid_here, words) -> None:
    shown = symbid_here(*words[1:], "-h")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert shown.stdout == symbid_here(*words[1:], "--help").stdout
    if words not in (("symbid",), ("symbid", "bag")):
        assert "--verbose -v" in " ".join(shown.stdout.split())
        assert "--quiet" in shown.stdout


def test_verbose_names_steps_and_quiet_leaves_warnings_out(symbid_here, short, tmp_path) -> None:
    plain = symbid_here("bag", "doctor", short)
    assert plain.stderr == ""  # no progress when piped
    steps = symbid_here("bag", "doctor", short, "-v")
    assert f"reading {short}" in "".join(steps.stderr.split("\n")).replace("  ", "")
    assert steps.stdout == plain.stdout
    assert symbid_here("bag", "doctor", short, "-q").stdout == plain.stdout
    assert symbid_here("bag", "doctor", short).stderr == ""  # flags end with their command

    model, out = config_file("symbitron.urdf"), tmp_path / "robot.yaml"
    init = symbid_here("init", "--model", model, "--bag", short, "--out", out, "-v")
    assert f"reading {short}" in "".join(init.stderr.split("\n")).replace("  ", "")

    robot = tmp_path / "massless.urdf"
    robot.write_text(
        '<robot name="r"><link name="world"/><link name="arm"/><joint name="j" type="continuous">'
        '<parent link="world"/><child link="arm"/></joint><joint name="k" type="continuous">'
        '<parent link="arm"/><child link="hand"/></joint><link name="hand"><inertial>'
        '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link></robot>"
    )
    words = "prior", "--model", robot, "--percent", 5, "--out", tmp_path / "prior.json"
    (warning,) = symbid_here(*words).stderr.splitlines()
    assert "link arm moves but has no mass" in warning
    assert symbid_here(*words, "-q").stderr == ""


@pytest.mark.parametrize(("flags", "is_shown"), [((), True), (("--quiet",), False)])
def test_progress_is_shown_on_a_terminal(short, flags, is_shown) -> None:
    main, terminal = pty.openpty()
    words = [SYMBID, "bag", "doctor", short, *flags]
    environment = {**os.environ, "COLUMNS": "200", "TERM": "xterm"}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=terminal, env=environment, text=True
    ) as process:
        os.close(terminal)
        shown = b""
        while True:
            try:
                part = os.read(main, 1 << 16)
            except OSError:  # Linux reports the end of a terminal so
                break
            if not part:
                break
            shown += part
        assert process.stdout is not None
        printed = process.stdout.read()
    os.close(main)
    assert "clean" in printed
    assert (b"reading" in shown and b"left" in shown) == is_shown


def test_progress_reaches_the_listener_alone() -> None:
    heard: list[tuple[str, float | None]] = []
    report("before", 0.5)
    with reported_to(lambda step, share: heard.append((step, share))):
        report("reading", 0.25)
        report("solving")
    report("after")
    assert heard == [("reading", 0.25), ("solving", None)]


def test_bash_completes_commands_and_options() -> None:
    script = (
        f"source <(env _SYMBID_COMPLETE=source_bash {SYMBID}); "
        f"COMP_WORDS=({SYMBID} iden); COMP_CWORD=1; _symbid_completion {SYMBID}; "
        'echo "${COMPREPLY[@]}"; '
        f"COMP_WORDS=({SYMBID} identify --joint-te); COMP_CWORD=2; _symbid_completion {SYMBID}; "
        'echo "${COMPREPLY[@]}"'
    )
    ended = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["identify", "--joint-terms"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_completions(shell) -> None:
    """What the scripts of the shells ask for, also where these are not installed."""
    asked = {
        "_SYMBID_COMPLETE": f"complete_{shell}",
        "_TYPER_COMPLETE_ARGS": "symbid val",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    ended = subprocess.run(
        [SYMBID], env={**os.environ, **asked}, capture_output=True, text=True, check=False
    )
    assert "validate" in ended.stdout


def test_fish_completes_commands_and_options(tmp_path) -> None:
    if shutil.which("fish") is None:
        pytest.skip("no fish found: its completion is not tested")
    script = (
        "env _SYMBID_COMPLETE=source_fish symbid | source; "
        "complete -C 'symbid iden'; complete -C 'symbid identify --joint-te'"
    )
    ended = subprocess.run(
        ["fish", "--no-config", "-c", script],
        env=shell_environment(tmp_path),
        capture_output=True,
        text=True,
        check=True,
    )
    words = [line.split("\t")[0] for line in ended.stdout.splitlines()]
    assert words == ["identify", "--joint-terms"]


@pytest.mark.parametrize(
    ("typed", "completed"),
    [("iden", "identify"), ("identify --joint-te", "--joint-terms"), ("diff resu", "result")],
)
def test_zsh_completes_commands_options_and_files_at_its_prompt(tmp_path, typed, completed) -> None:
    if shutil.which("zsh") is None:
        pytest.skip("no zsh found: its completion is not tested")
    (tmp_path / "result").mkdir()
    main, terminal = pty.openpty()
    with subprocess.Popen(
        ["zsh", "-f", "-i"],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        cwd=tmp_path,
        env=shell_environment(tmp_path),
        start_new_session=True,
    ) as shell:
        os.close(terminal)
        setup = (
            'autoload -Uz compinit; compinit -u -D; eval "$(_SYMBID_COMPLETE=source_zsh symbid)"'
        )
        os.write(main, f"{setup}; echo rea''dy\n".encode())
        read_until(main, "ready\r\n")
        os.write(main, f"symbid {typed}\t".encode())
        read_until(main, completed)
        shell.kill()
    os.close(main)


def shell_environment(home: Path) -> dict[str, str]:
    """Return an environment in which a shell finds the command and no one's settings."""
    path = f"{SYMBID.parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "HOME": str(home), "TERM": "xterm", "COLUMNS": "120"}


def read_until(terminal: int, text: str) -> None:
    """Read what a terminal shows until it contains a text."""
    shown = b""
    while text.encode() not in shown:
        ready, _, _ = select.select([terminal], [], [], DEADLINE)
        assert ready, shown
        shown += os.read(terminal, 1 << 16)


def test_help_on_a_narrow_terminal_has_complete_names(symbid_here) -> None:
    shown = symbid_here("excite", "--help", columns=60).stdout
    assert "--accelerometer-noise" in shown
    assert max(map(len, shown.splitlines())) <= 60


def test_warnings_about_a_model_are_logged_once_by_a_command(tmp_path, caplog) -> None:
    robot = tmp_path / "robot.xml"
    robot.write_text(
        '<mujoco><option density="1"/><worldbody><body name="arm"><joint name="j"/>'
        '<geom size=".1"/></body></worldbody></mujoco>'
    )
    for commands_so_far in (1, 2):
        with logged_level(0):
            load_model(robot)
            load_model(robot)
        assert len(caplog.records) == commands_so_far
