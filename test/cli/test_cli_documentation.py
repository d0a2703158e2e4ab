"""Runs each code block of README and docs/ and compares its output with the page.

Commands of ``symbid`` and Python code run unchanged, in a folder with the files that a reader would
have; what a command prints is compared with the page. Other commands (NOT_RUN gives the reasons)
are checked against the parser, parameters or launch arguments.

``UPDATE_PAGES=1 pytest test/cli/test_cli_documentation.py`` updates the output shown on the pages.
"""

import ast
import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
import typer.main
import yaml
from documented_robots import write_arm, write_inaccurate

import symbid_ros
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
    "python",
    "sudo",
    "source",
    "rosdep",
    "git",
]
NODES = {
    *("mujoco_bridge", "balance_controller", "recorder", "player", "identifier", "monitor"),
    "web_monitor",
}
NOT_RUN = {
    r"symbid demo\b": "runs for a minute; test_cli_demo.py and test_cli_online_demo.py run it",
    r"symbid .*lwr4": "needs data that the reader downloads; test_bench_real_logs.py runs it",
    r"symbid .*(plan|rehears|other_anymal)": "takes minutes; test_cli_rehearsal.py runs it",
    r"symbid identify .*--information": "test_cli_identify.py continues a run like this",
    r"symbid (identify|validate) .*--robot": "test_cli_robot_file.py runs them with such a file",
    r"symbid .*--dask": "needs a cluster; test/cluster runs the commands on a local one",
    r"symbid fleet\b": "needs several robots; test_identification_fleet.py compares some",
    r"symbid study\b": "runs for hours; test_study_small.py runs a small one",
    r"symbid live\b": "identifies a running robot until Ctrl-C; test_cli_live.py runs it",
    r"symbid udp-client\b": "needs a simulated robot; test_cli_udp_client.py runs it",
    r"make\b": "installs, tests or demonstrates everything",
    r"git\b": "fetches the project",
    r"(ros2 run symbid_ros )?(" + "|".join(NODES) + r")\b": "a node, which needs a robot",
    r"ros2 (launch|service|param|topic|run)\b": "needs ROS's own command line and a running graph",
    r"(python3 -m )?colcon (build|test)\b": "test_packaging.py builds and tests",
    r"(export|unset|source)\b": "sets up the user's shell",
    r"(sudo|pip|python3|rosdep)\b": "installs",
    r"python bench/": "needs data that the reader downloads; test_bench_real_logs.py runs it",
    r"python -m symbid_ros": "writes config/; test_ros_launch_arguments.py compares the files",
}
# Of rcl, of rosbag2 and of bench/recorder.py.
OTHER_OPTIONS = {
    "--ros-args",
    "--params-file",
    "--compression-mode",
    "--kills",
    "--images",
    "--show-args",
    "--robots",
    "--draws",
    "--table",
    "--bags",
    "--held-out",
    "--replace",
}
SHELL = ("", "sh", "console")
PROMPT = "$ "
TRIMMED = "..."
# Run by a test of their own.
ENDLESS = {"udp.md"}  # test_simulation_udp.py


@dataclass(frozen=True)
class Block:
    """A fenced block; an indented one has no language."""

    page: Path
    language: str
    lines: tuple[str, ...]


@dataclass(frozen=True)
class Command:
    """A command without ``.venv/bin/``, and what it is shown to print, if anything is."""

    page: Path
    words: str
    output: tuple[str, ...] | None = None

    @property
    def label(self) -> str:
        return f"{self.page.relative_to(ROOT)}: {self.words}"


def blocks(page: Path) -> list[Block]:
    found, lines, fence, marker_indent = [], [], None, 0
    for line in [*page.read_text(encoding="utf-8").splitlines(), ""]:
        marker = re.match(r" *(`{3,}|:{3,})(.*)", line)
        if fence is not None and marker and marker[1] == fence[0] and not marker[2]:
            found.append(Block(page, fence[1], tuple(lines)))
            lines, fence = [], None
        elif fence is not None:
            lines.append(line[marker_indent:])
        elif marker:
            fence, marker_indent = (marker[1], marker[2].strip()), marker.start(1)
        elif line.startswith("    "):
            lines.append(line[4:])
        elif lines:
            found.append(Block(page, "", tuple(lines)))
            lines = []
    return found


def commands(block: Block) -> list[Command]:
    """Return the commands that a block of a shell shows, without comments."""
    if block.language not in SHELL:
        return []
    found: list[Command] = []
    has_output = block.language == "console"
    for line in block.lines:
        if has_output and not line.startswith(PROMPT):
            last = found.pop()
            found.append(Command(last.page, last.words, (*(last.output or ()), line)))
            continue
        text = re.sub(r"\s+#.*", "", line).strip().removeprefix(PROMPT)
        for words in map(str.strip, text.split("&&")):
            plain = words.removeprefix(".venv/bin/")
            if plain != words or words.split(" ")[0] in PROGRAMS:
                found.append(Command(block.page, plain, () if has_output else None))
    return found


BLOCKS = [block for page in PAGES for block in blocks(page)]
COMMANDS = [command for block in BLOCKS for command in commands(block)]
PROGRAMMED = {
    page: "\n".join(
        "\n".join(block.lines)
        for block in BLOCKS
        if (block.page, block.language) == (page, "python")
    )
    for page in {block.page for block in BLOCKS if block.language == "python"}
}
# What the README shows is the beginning of another page.
PROGRAMMED = {
    page: program
    for page, program in PROGRAMMED.items()
    if not any(other.startswith(program) for one, other in PROGRAMMED.items() if one != page)
}
RUN = [each for each in COMMANDS if not any(re.match(one, each.words) for one in NOT_RUN)]
INLINE = [
    (page, span)
    for page in PAGES
    for span in re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
]


def shown_by(pattern: str) -> list:
    """Return the commands that match, each a case of a test."""
    return [pytest.param(one, id=one.label) for one in COMMANDS if re.search(pattern, one.words)]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory, simulated) -> Path:
    """Return a folder with what the pages take for granted."""
    folder = tmp_path_factory.mktemp("checkout")
    (folder / "config").symlink_to(ROOT / "config")
    copy_bag(simulated("smooth", moves=5, motion_seed=1), folder / "my_bag")
    write_inaccurate(ROOT / "config" / "symbitron.urdf", folder / "my_robot.urdf", seed=1)
    write_arm(folder)
    return folder


def copy_bag(bag: Path, copy: Path) -> None:
    """Copy a bag of one file, whose file gets the name of the copy, as recorders name it."""
    copy.mkdir()
    for file in bag.iterdir():
        shutil.copy(file, copy / file.name.replace(bag.name, copy.name))
    metadata = copy / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(bag.name, copy.name))


def test_the_pages_show_what_the_commands_printed() -> None:
    """Should the blocks be written in another way, none of them would be looked at."""
    assert len(RUN) >= 10
    assert sum(each.output is not None for each in RUN) >= 4
    assert len(COMMANDS) >= 25
    unused = [one for one in NOT_RUN if not any(re.match(one, each.words) for each in COMMANDS)]
    assert not unused


def test_commands_of_symbid_do_and_print_what_is_shown(symbid_here, checkout, monkeypatch) -> None:
    monkeypatch.chdir(checkout)
    printed: dict[str, list[str]] = {}
    for each in RUN:
        if each.words not in printed:  # what several pages show is run once
            program, *words = shlex.split(each.words)
            assert program == "symbid", f"{each.label}: say in NOT_RUN why it is not run"
            if words[0] == "identify":  # pages share the names of folders
                shutil.rmtree(words[words.index("--out") + 1], ignore_errors=True)
            ended = symbid_here(*words)
            assert (ended.returncode, ended.stderr) == (0, ""), each.label
            printed[each.words] = ended.stdout.rstrip("\n").split("\n")
        if each.output is not None and os.environ.get("UPDATE_PAGES"):
            update(each, printed[each.words])
        elif each.output is not None:
            require_output(each, printed[each.words])


def require_output(command: Command, printed: list[str]) -> None:
    """Require that a command prints what is shown; a line of ``...`` stands for any lines."""
    place = 0
    may_skip = False
    for line in command.output or ():
        if line.strip() == TRIMMED:
            may_skip = True
            continue
        found = next((i for i in range(place, len(printed)) if are_alike(line, printed[i])), None)
        assert found is not None, f"{command.label}: does not print: {line}"
        assert may_skip or found == place, f"{command.label}: prints more before: {line}"
        place, may_skip = found + 1, False
    assert may_skip or place == len(printed), f"{command.label}: prints more: {printed[place:]}"


NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]\d+)?")


def are_alike(shown: str, printed: str) -> bool:
    """Return whether lines agree but for blanks and the last digits of numbers."""
    if NUMBER.sub("#", "".join(shown.split())) != NUMBER.sub("#", "".join(printed.split())):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.02, abs=0.002) for a, b in pairs)


def update(command: Command, printed: list[str]) -> None:
    """Write what a command prints into its page, trimmed where it was trimmed before."""
    old = [*(command.output or ())]
    new = [line.rstrip() for line in printed]
    if TRIMMED in old:
        before, after = old.index(TRIMMED), old[::-1].index(TRIMMED)
        # What stands between two trimmed parts is found by its words.
        by_words = {NUMBER.sub("#", line): line for line in new}
        middle = [by_words.get(NUMBER.sub("#", one), one) for one in old[before : len(old) - after]]
        new = [*new[:before], *middle, *new[len(new) - after :]]
    shown = re.escape(command.words + "\n" + "".join(f"{line}\n" for line in old))
    text = command.page.read_text(encoding="utf-8")
    whole = command.words + "\n" + "".join(f"{line}\n" for line in new)
    text = re.sub(rf"(?<=\n\$ )(\.venv/bin/)?{shown}", lambda found: (found[1] or "") + whole, text)
    command.page.write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    "page",
    sorted(page for page in PROGRAMMED if page.name not in ENDLESS),
    ids=lambda page: page.name,
)
def test_python_runs_as_it_is_shown(page, checkout, short, tmp_path, monkeypatch) -> None:
    for made in checkout.iterdir():
        (tmp_path / made.name).symlink_to(short if made.name == "my_bag" else made)
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(PROGRAMMED[page], page, "exec"), {})
    of_page = [block for block in BLOCKS if block.page == page]
    for code, shown in pairwise(of_page):
        if (code.language, shown.language) == ("python", "text"):
            for line in shown.lines:
                assert any(are_alike(line, one) for one in printed.getvalue().splitlines()), line


def test_data_is_well_formed() -> None:
    read = {
        "yaml": yaml.safe_load,
        "json": json.loads,
        "toml": tomllib.loads,
        "xml": ElementTree.fromstring,
    }
    languages = {block.language for block in BLOCKS if not block.language.startswith("{")}
    assert languages <= {*SHELL, *read, "python", "text"}
    for block in BLOCKS:
        if block.language in read:
            assert read[block.language]("\n".join(block.lines)) is not None


@cache
def whole_command():
    """Return the parser of ``symbid``, which takes a tenth of a second to make."""
    return typer.main.get_command(app)


def command_named(words: list[str]):
    """Return the command of ``symbid`` that words begin with, and the words after its name."""
    command = whole_command()
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


def options_of(command) -> set[str]:
    below = getattr(command, "commands", {}).values()
    options = {word for option in command.params for word in option.opts}
    return options.union({"--help"}, *map(options_of, below))


@pytest.mark.parametrize("command", shown_by(r"^symbid "))
def test_the_parser_takes_every_command(command) -> None:
    found, words = command_named(shlex.split(command.words)[1:])
    found.make_context("symbid", words)


@pytest.mark.parametrize("command", shown_by(r"^make "))
def test_the_makefile_has_every_target(command) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {word for word in command.words.split()[1:] if "=" not in word} <= set(targets)


@pytest.mark.parametrize("command", shown_by(":="))
def test_nodes_and_launch_files_know_every_argument(command) -> None:
    words = shlex.split(command.words)
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


@pytest.mark.parametrize("command", shown_by("^ros2 (param set|service call)"))
def test_nodes_have_every_parameter_and_service(command) -> None:
    _, kind, _, target, which = command.words.split()[:5]
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
            assert named <= options_of(command), f"{page.name}: {span}"
            assert command.name != "symbid" or not words or named, f"{page.name}: {span}"


def test_options_in_running_text_are_those_of_a_command() -> None:
    known = options_of(whole_command())
    for page, span in INLINE:
        if span.startswith("--") and page.name != "CONTRIBUTING.md":
            option = span.split()[0].split("=")[0]
            assert option in known | OTHER_OPTIONS, f"{page.name}: {span}"


def test_links_lead_to_sections_that_github_has() -> None:
    """GitHub makes names of headings in a way of its own; the site accepts these names too."""

    def sections(page: Path) -> set[str]:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}

    for page in PAGES:
        for file, section in re.findall(
            r"\]\(([\w./-]*\.md)?#([^)]+)\)", page.read_text(encoding="utf-8")
        ):
            target = (page.parent / file) if file else page
            assert section in sections(target), f"{page.name}: {file}#{section}"


def test_the_readme_lists_every_page() -> None:
    elsewhere = {"index.md", "changelog.md", "contributing.md"}
    listed = set(re.findall(r"\]\(docs/([\w-]+\.md)", (ROOT / "README.md").read_text()))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - elsewhere == listed


def test_files_named_in_running_text_exist() -> None:
    named = [
        (page.name, span)
        for page, span in INLINE
        if re.fullmatch(r"[\w/]+\.py|[\w/]+/[\w.]+\.(yaml|xml)", span)
    ]
    folders = ROOT, ROOT / "symbid_ros"
    assert not [each for each in named if not any((one / each[1]).is_file() for one in folders)]


def test_measurements_have_the_options_named() -> None:
    called = [span for _, span in INLINE if "bench/" in span and span.split()[0].endswith("python")]
    called += [re.sub(r"^", "python ", span) for _, span in INLINE if span.startswith("bench/")]
    assert called
    for span in called:
        script, *words = span.split()[1:]
        known = re.findall(r'add_argument\(\s*"(--[\w-]+)"', (ROOT / script).read_text())
        assert {word for word in words if word.startswith("--")} <= set(known), span


@pytest.mark.parametrize("command", shown_by("^export"))
def test_files_in_shell_commands_exist(command) -> None:
    done = subprocess.run(
        ["bash", "-ec", f"{command.words}; env"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    variable = command.words.split()[1].split("=")[0]
    (value,) = re.findall(rf"^{variable}=(.*)", done.stdout, re.MULTILINE)
    assert not value.startswith("/") or Path(value).is_file()


GENERATED = [
    pytest.param(block, id=f"{block.page.name}: {block.language}")
    for block in BLOCKS
    if re.match(r"\{(options|schema|parameters|public-api)\} ", block.language)
]


@pytest.mark.parametrize("block", GENERATED)
def test_what_only_the_site_shows_is_found_from_the_repository(block) -> None:
    """GitHub shows the text of the block, the site a table."""
    kind, name = re.match(r"\{(\S+)\} (.*)", block.language).groups()
    (source, *_) = re.findall(r"`([^`]+)`", block.lines[0])
    if kind == "options":
        assert source == f"symbid {name} --help"
        command = typer.main.get_command(app)
        for word in name.split():
            command = command.commands[word]
    elif kind == "parameters" and source.startswith("ros2 param describe"):
        assert source == f"ros2 param describe /{name} NAME"
        assert name in NODES
    elif kind == "public-api":
        function = re.fullmatch(r"help\(symbid_ros\.(\w+)\)", source)[1]
        assert getattr(symbid_ros, function).__doc__
    else:
        assert (ROOT / source).is_file()
