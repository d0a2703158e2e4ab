"""Every command in README and the pages under docs/ does what it is shown for.

Commands of ``symbid`` are run as they stand, in a folder that looks like the checkout. The rest
(NOT_RUN says why) are held against the parser, parameters or launch arguments they are meant for.
"""

import ast
import re
import shlex
import subprocess
from importlib import import_module
from pathlib import Path

import pytest
import typer.main
import yaml

from symbid_ros.cli.app import app
from symbid_ros.ros.launch_arguments import launch_arguments

ROOT = Path(__file__).resolve().parents[2]
# bags/README.md makes the bag that the others read.
PAGES = [
    ROOT / "bags" / "README.md",
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PROGRAMS = [
    "symbid",
    "make",
    "ros2",
    "colcon",
    "export",
    "unset",
    "pip",
    "python3",
    "sudo",
    "source",
    "rosdep",
]
DRAWN = set("│─")  # of diagrams
NODES = {"mujoco_bridge", "balance_controller", "recorder", "player", "identifier", "monitor"}
NOT_RUN = {
    r"symbid demo\b": "runs for a minute; test_cli_demo.py and test_cli_online_demo.py run it",
    r"symbid study\b": "runs for hours; test_study_small.py runs a small one",
    r"symbid udp-client\b": "needs a simulated robot; test_cli_udp_client.py runs it",
    r"make \w+": "installs, tests or demonstrates everything",
    r"(ros2 run symbid_ros )?(" + "|".join(NODES) + r")\b": "a node, which needs a robot",
    r"ros2 (launch|service|param)\b": "needs ROS's own command line, and a running graph",
    r"(python3 -m )?colcon (build|test)\b": "test_packaging.py builds and tests",
    r"(export|unset|source)\b": "sets up the user's shell",
    r"(sudo|pip|python3|rosdep)\b": "installs",
    r"python bench/": "measures for minutes",
}
# Of rcl, of rosbag2 and of bench/recorder.py.
OTHER_OPTIONS = {
    "--ros-args",
    "--params-file",
    "--compression-mode",
    "--kills",
    "--images",
    "--show-args",
}


def shown(page: Path) -> list[str]:
    """Return the commands that a page shows in indented or fenced blocks, without comments."""
    lines, is_fenced, language, found = page.read_text(encoding="utf-8").splitlines(), False, "", []
    for line in lines:
        if line.lstrip().startswith("```"):
            is_fenced, language = not is_fenced, line.strip().removeprefix("```")
        elif DRAWN.intersection(line):
            continue
        elif (is_fenced and language in ("", "sh", "bash", "console")) or (
            not is_fenced and line.startswith("    ")
        ):
            text = re.sub(r"\s+#.*", "", line).strip().removeprefix("$ ")
            for command in map(str.strip, text.split("&&")):
                plain = command.removeprefix(".venv/bin/")
                if plain != command or command.split(" ")[0] in PROGRAMS:
                    found.append(plain)
    return found


COMMANDS = [(page, command) for page in PAGES for command in shown(page)]
RUN = [each for each in COMMANDS if not any(re.match(one, each[1]) for one in NOT_RUN)]
INLINE = [
    (page, span)
    for page in PAGES
    for span in re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
]


def name(command: tuple[Path, str]) -> str:
    page, words = command
    return f"{page.relative_to(ROOT)}: {words}"


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    """Return a folder with what the pages take for granted."""
    folder = tmp_path_factory.mktemp("checkout")
    (folder / "config").symlink_to(ROOT / "config")
    return folder


def in_the_checkout(command: str) -> str:
    """Return a command with the reader's own files replaced by those of bags/README.md."""
    for own, ours in {
        "my_bag": "bags/sample",
        "my_robot.urdf": "config/symbitron.urdf",
        " result": " sample_result",
    }.items():
        command = command.replace(own, ours)
    return command


def test_the_pages_show_what_they_did() -> None:
    """Should the blocks be written in another way, none of them would be looked at."""
    assert len(RUN) >= 7
    assert len(COMMANDS) >= 25
    unused = [one for one in NOT_RUN if not any(re.match(one, words) for _, words in COMMANDS)]
    assert set(unused) <= {r"(sudo|pip|python3|rosdep)\b", r"python bench/"}


def test_commands_of_symbid_run_as_they_are_shown(symbid_here, checkout, monkeypatch) -> None:
    monkeypatch.chdir(checkout)
    # What several pages show is run once.
    for command, page in {in_the_checkout(words): page for page, words in RUN}.items():
        program, *words = shlex.split(command)
        assert program == "symbid", f"{page}: {command}: say in NOT_RUN why it is not run"
        ended = symbid_here(*words)
        assert (ended.returncode, ended.stderr) == (0, ""), f"{page}: {command}"


def command_named(words: list[str]):
    """Return the command of ``symbid`` that words begin with, and the words after its name."""
    command = typer.main.get_command(app)
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


def options_of(command) -> set[str]:
    below = getattr(command, "commands", {}).values()
    options = {word for option in command.params for word in option.opts}
    return options.union({"--help"}, *map(options_of, below))


@pytest.mark.parametrize(
    "command", [each for each in COMMANDS if each[1].startswith("symbid ")], ids=name
)
def test_the_parser_takes_every_command(command) -> None:
    found, words = command_named(shlex.split(command[1])[1:])
    found.make_context("symbid", words)


@pytest.mark.parametrize(
    "command", [each for each in COMMANDS if each[1].startswith("make ")], ids=name
)
def test_the_makefile_has_every_target(command) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {word for word in command[1].split()[1:] if "=" not in word} <= set(targets)


@pytest.mark.parametrize("command", [each for each in COMMANDS if ":=" in each[1]], ids=name)
def test_nodes_and_launch_files_know_every_argument(command) -> None:
    words = shlex.split(command[1])
    given = dict(word.split(":=", 1) for word in words if ":=" in word)
    if words[:2] == ["ros2", "launch"]:
        tree = ast.parse((ROOT / "launch" / words[3]).read_text())
        named = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        if words[3] == "replay.launch.py":  # it includes the other
            named.add("identifier")
        of_nodes = {one.name for one in launch_arguments(*(NODES & named))}
        assert set(given) <= named | of_nodes
        return
    (node,) = NODES.intersection(words)
    parameters = {one.name: one for one in import_module(f"symbid_ros.ros.{node}").PARAMETERS}
    for key, text in given.items():
        parameters[key].require(yaml.safe_load(text))


@pytest.mark.parametrize(
    "command",
    [each for each in COMMANDS if re.match(r"ros2 (param set|service call)", each[1])],
    ids=name,
)
def test_nodes_have_every_parameter_and_service(command) -> None:
    _, kind, _, target, which = command[1].split()[:5]
    node = target.split("/")[1]
    if kind == "param":
        live = {p.name for p in import_module(f"symbid_ros.ros.{node}").PARAMETERS if p.live}
        assert which in live
    else:
        sources = (ROOT / "symbid_ros" / "ros").glob("*.py")
        service = target.split("/")[2]
        named = re.compile(rf'"(~/)?{service}"')
        assert any(named.search(source.read_text()) for source in sources)


def test_commands_in_running_text_have_the_options_named() -> None:
    for page, span in INLINE:
        if (plain := span.removeprefix(".venv/bin/")).startswith("symbid "):
            command, words = command_named(plain.split()[1:])
            named = {word.split("=")[0] for word in words if word.startswith("--")}
            assert named <= options_of(command), name((page, span))
            assert command.name != "symbid" or not words or named, name((page, span))


def test_options_in_running_text_are_those_of_a_command() -> None:
    known = options_of(typer.main.get_command(app))
    for page, span in INLINE:
        if span.startswith("--") and page.name != "CONTRIBUTING.md":
            option = span.split()[0].split("=")[0]
            assert option in known | OTHER_OPTIONS, name((page, span))


def test_measurements_have_the_options_named() -> None:
    called = [span for _, span in INLINE if "bench/" in span and span.split()[0].endswith("python")]
    called += [re.sub(r"^", "python ", span) for _, span in INLINE if span.startswith("bench/")]
    assert called
    for span in called:
        script, *words = span.split()[1:]
        known = re.findall(r'add_argument\("(--[\w-]+)"', (ROOT / script).read_text())
        assert {word for word in words if word.startswith("--")} <= set(known), span


@pytest.mark.parametrize(
    "command", [each for each in COMMANDS if each[1].startswith("export")], ids=name
)
def test_files_that_a_shell_is_pointed_to_exist(command) -> None:
    done = subprocess.run(
        ["bash", "-ec", f"{command[1]}; env"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    variable = command[1].split()[1].split("=")[0]
    (value,) = re.findall(rf"^{variable}=(.*)", done.stdout, re.MULTILINE)
    assert not value.startswith("/") or Path(value).is_file()
