"""`symbid live`: its nodes, its page, and how it ends."""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import nullcontext
from pathlib import Path
from typing import ClassVar

import pytest
import rclpy
import typer
from expected_errors import raises_code
from rclpy.context import Context
from rclpy.node import Node
from rich.console import Console

from symbid_ros.cli.flags import flag
from symbid_ros.cli.live import OF_COMPLETE_LOGS, given_parameters, report_end, saved_part_named
from symbid_ros.errors import SymbidError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.package_paths import config_file
from symbid_ros.ros.node_names import BUSY_DISCOVERY, DISCOVERY, discovery_time

DEADLINE = 300.0  # s; only a hang takes longer
MODEL = config_file("symbitron.urdf")


def test_options_become_parameters_of_the_node(tmp_path) -> None:
    options = IdentifyOptions(prior=tmp_path / "prior.json", joint_terms=("none",), total_mass=40.0)
    given = given_parameters(options, LogOptions(frame_prefix="robot1/"))
    assert json.loads(json.dumps(given)) == {
        "prior": str(tmp_path / "prior.json"),
        "joint_terms": ["none"],
        "total_mass": 40.0,
        "frame_prefix": "robot1/",
    }
    assert given_parameters(IdentifyOptions(), LogOptions()) == {}


def test_a_wrong_model_is_reported_before_any_node_starts(symbid_here, tmp_path) -> None:
    missing = symbid_here("live", tmp_path / "missing.urdf")
    assert missing.returncode == 2
    assert "E101" in missing.stderr
    unnamed = symbid_here("live").stderr
    assert "there is no model; give MODEL, or a --robot file" in unnamed
    assert "E501" in unnamed


@pytest.mark.parametrize("name", ["bad name", "a//b", "1x"])
def test_an_invalid_namespace_is_refused(symbid_here, name: str) -> None:
    refused = symbid_here("live", MODEL, "--namespace", name)
    assert refused.returncode == 2
    assert f"--namespace: {name!r} is not a ROS namespace" in refused.stderr
    assert "E501" in refused.stderr


@pytest.mark.parametrize(
    "option", [("--start", 10), ("--stop", 10), ("--no-holdout",), ("--jobs", 2), ("--full-rate",)]
)
def test_options_of_complete_logs_are_refused(symbid_here, option) -> None:
    refused = symbid_here("live", MODEL, *option)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert f"{option[0]} has no effect live" in refused.stderr
    assert "E503" in refused.stderr


@pytest.mark.parametrize("name", OF_COMPLETE_LOGS)
def test_the_help_leaves_out_options_that_are_always_refused(symbid_here, name) -> None:
    row = re.compile(rf"^│ +{flag(name)} ", re.MULTILINE)
    shown = {
        command: row.search(symbid_here(command, "--help", columns=200).stdout) is not None
        for command in ("identify", "live")
    }
    assert shown == {"identify": True, "live": False}


def test_an_earlier_result_is_kept(symbid_here, tmp_path) -> None:
    (tmp_path / "estimate.json").write_text("earlier")
    refused = symbid_here("live", MODEL, "--out", tmp_path)
    assert refused.returncode == 2
    assert "give --overwrite" in refused.stderr
    assert "E551" in refused.stderr


def test_the_end_repeats_warnings_and_alarms(capsys, caplog) -> None:
    console = Console(width=200)
    report_end({"saved": "9 of 10 parameters, written to out", "alarms": []}, console)
    summary = {"saved": "written to out", "warnings": ["old data"], "alarms": ["give `contact`"]}
    with pytest.raises(typer.Exit) as end:
        report_end(summary, console)
    assert end.value.exit_code == 1
    assert caplog.messages == ["old data"]
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "written to out",
        "alarm: give --contact",
        "1 alarm: do not trust these numbers yet",
    ]


class EndedNode:
    """Stands for the process of a node that is interrupted at once."""

    was_interrupted = was_killed = False
    summary: ClassVar[dict[str, object] | None]

    def __init__(self, name, parameters, environment, log: Path, **options) -> None:
        log.write_text("started")

    def __enter__(self) -> "EndedNode":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def require_running(self) -> None:
        raise KeyboardInterrupt

    def finish(self, *, stop: bool, patience: float) -> dict[str, object]:
        if self.summary is None:
            raise SymbidError("identifier failed", "E553")
        return self.summary


@pytest.mark.parametrize(
    ("summary", "error", "is_kept"),
    [
        ({"saved": "written"}, None, False),
        ({"saved": "written", "alarms": ["do not trust it"]}, typer.Exit, False),
        (None, SymbidError, True),
    ],
)
def test_logs_of_the_nodes_are_kept_after_an_error_alone(
    summary, error, is_kept, monkeypatch, tmp_path, capsys
) -> None:
    from symbid_ros import shutdown
    from symbid_ros.cli import live as module

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name in ("exit_on_signals", "interrupt_on_sigterm"):  # of the process of the tests
        monkeypatch.setattr(shutdown, name, lambda: None)
    monkeypatch.setattr(EndedNode, "summary", summary, raising=False)
    monkeypatch.setattr(module, "NodeProcess", EndedNode)
    monkeypatch.setattr(module, "unused_node_name", lambda name, *_: nullcontext(name))
    with nullcontext() if error is None else pytest.raises(error):
        module.live.__wrapped__(model=MODEL, options=IdentifyOptions(), log=LogOptions())
    kept = [str(folder) for folder in tmp_path.iterdir()]
    assert len(kept) == is_kept
    assert all(folder in capsys.readouterr().out.replace("\n", "") for folder in kept)


@pytest.mark.parametrize(("age", "says"), [(-60, "keeps what was saved at"), (60, "nothing of")])
def test_the_error_of_a_killed_identifier_tells_what_is_saved(tmp_path, age, says) -> None:
    """A result of before this run is not its own."""
    saved = tmp_path / "estimate.json"
    saved.write_text("{}")
    os.utime(saved, times=2 * (time.time() - age,))
    ended = EndedNode("identifier", {}, {}, tmp_path / "log")
    for was_killed, folder in ((True, tmp_path), (False, tmp_path), (True, None)):
        ended.was_killed = was_killed
        with raises_code("E553") as raised, saved_part_named(ended, folder):
            raise SymbidError("the identifier ended", "E553")
        assert (says in str(raised.value)) == (was_killed and folder is not None)


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_without_a_robot_it_waits_with_its_page_until_a_signal(number: signal.Signals) -> None:
    command = [Path(sys.executable).parent / "symbid", "live", MODEL, "--web", "--port", "0"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ),
        start_new_session=True,
    )
    try:
        assert process.stdout.readline().startswith("preparing: ")
        line = process.stdout.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", line)
        assert address, line
        with urllib.request.urlopen(address[0], timeout=DEADLINE) as page:
            assert "symbitron" in page.read().decode()
        events = address[0].replace("/?", "/events?")
        with urllib.request.urlopen(events, timeout=DEADLINE) as stream:
            # The identifier reports what it waits for.
            assert any(b"no sensor topics yet" in line for line in stream)
        process.send_signal(number)
        _, err = process.communicate(timeout=DEADLINE)
    finally:
        if process.poll() is None:
            process.terminate()
            process.communicate()
    assert process.returncode == 2
    (failure,) = err.splitlines()
    assert "stopped without an estimate" in failure


def test_an_identifier_beside_another_one_is_found(domain: int) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    first = Node("identifier", context=context)
    try:
        command = [sys.executable, "-m", "symbid_ros.ros.node_names"]
        # The wait ends soon after the node is found.
        found = subprocess.run(
            [*command, "identifier", "/", str(DEADLINE)], capture_output=True, text=True, check=True
        )
        assert "identifier" in found.stdout.split()
        found = subprocess.run(
            [*command, "identifier", "/arm"], capture_output=True, text=True, check=True
        )
        assert found.stdout.split() == []
    finally:
        first.destroy_node()
        context.try_shutdown()


def test_a_namespace_selects_the_identifier_of_one_robot(domain: int) -> None:
    command = [Path(sys.executable).parent / "symbid", "live", MODEL, "--namespace", "arm"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout.readline().startswith("preparing: ")
        line = process.stdout.readline()
        assert line.startswith("preparing: waiting for /arm/identifier, which")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE)


def test_a_busy_machine_gets_more_time_to_find_running_nodes(monkeypatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for load, expected in ((1.5, DISCOVERY), (2.5, BUSY_DISCOVERY)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert discovery_time() == expected
