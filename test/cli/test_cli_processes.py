"""Nodes end with the command, and unused ROS domains are found and reserved."""

import os
import signal
import subprocess
import sys

import pytest
import rclpy
from expected_errors import raises_code
from rclpy.context import Context

from symbid_ros.cli import processes
from symbid_ros.cli.processes import NodeProcess, unused_domain, unused_node_name
from symbid_ros.errors import SymbidError


def test_two_callers_get_different_domains():
    with unused_domain() as first, unused_domain() as second:
        assert first != second
        refused = pytest.raises(SymbidError, match="each of 2 ROS domains is in use")
        with refused, unused_domain([first, second]):
            pass
    # Another process may have reserved one of them by now.
    with unused_domain([first, second]) as again:
        assert again in {first, second}


@pytest.mark.parametrize("discovery", ["LOCALHOST", "SUBNET"])
def test_a_domain_with_a_node_is_in_use(tmp_path, monkeypatch, discovery: str) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", discovery)
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with unused_domain() as domain:
        pass
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("inhabitant", context=context)
    with pytest.raises(SymbidError), unused_domain([domain]):
        pass
    node.destroy_node()
    context.try_shutdown()
    with unused_domain([domain]) as again:
        assert again == domain


@pytest.mark.parametrize(
    ("last", "label"),
    [
        ("identifier: give `base` fixed (SYMBID-E811)", "give `base` fixed (see {}) (SYMBID-E811)"),
        ("Killed", "identifier failed: Killed (see {}) (SYMBID-E553)"),
    ],
)
def test_the_error_of_a_node_keeps_its_code(tmp_path, monkeypatch, last: str, label: str) -> None:
    log = tmp_path / "log"

    class Failing(subprocess.Popen):
        def __init__(self, _: object, **options) -> None:
            super().__init__(["sh", "-c", f"echo '{last}' >&2; exit 2"], **options)

    monkeypatch.setattr(subprocess, "Popen", Failing)
    node = NodeProcess("identifier", {}, os.environ, log)
    with pytest.raises(SymbidError) as raised:
        node.finish()
    assert raised.value.labelled == label.format(log)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_node_that_was_killed_is_not_blamed_on_its_last_line(
    tmp_path, monkeypatch, number: signal.Signals
) -> None:
    log = tmp_path / "log"

    class Killed(subprocess.Popen):
        def __init__(self, _: object, **options) -> None:
            command = f"echo '[WARN] an exact estimate takes long' >&2; kill -{number.value} $$"
            super().__init__(["sh", "-c", command], **options)

    monkeypatch.setattr(subprocess, "Popen", Killed)
    node = NodeProcess("identifier", {}, os.environ, log)
    with raises_code("E553", f"killed by signal {number.value}") as raised:
        node.finish()
    assert node.was_killed
    assert "estimate" not in str(raised.value)
    assert ("memory" in str(raised.value)) == (number == signal.SIGKILL)


def test_a_signal_while_a_node_starts_leaves_no_process(tmp_path, monkeypatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options)
            started.append(self)
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        NodeProcess("monitor", {}, os.environ, tmp_path / "log")
    (process,) = started
    assert process.returncode is not None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.fixture
def other_nodes(monkeypatch) -> set[str]:
    """Names that the ROS graph shows, in place of a look for some seconds."""
    names: set[str] = set()
    monkeypatch.setattr(processes, "_node_names", lambda *_: names)
    return names


def test_two_nodes_that_start_together_get_different_names(other_nodes: set[str]) -> None:
    """The first one is reserved before the graph shows it; another robot's is independent."""
    with unused_node_name("identifier", "/", {}) as first:
        with unused_node_name("identifier", "/", {"ROS_DOMAIN_ID": "0"}) as second:
            assert (first, second) == ("identifier", "identifier_2")
        for space, environment in (("/arm", {}), ("/", {"ROS_DOMAIN_ID": "7"})):
            with unused_node_name("identifier", space, environment) as name:
                assert name == "identifier"
    other_nodes |= {"identifier", "monitor"}
    with unused_node_name("identifier", "/", {}) as name:
        assert name == "identifier_2"


@pytest.mark.usefixtures("other_nodes")
def test_the_name_of_a_killed_command_is_free_again() -> None:
    code = (
        "import sys, time; from symbid_ros.cli import processes; "
        "processes._node_names = lambda *_: set()\n"
        "with processes.unused_node_name('identifier', '/killed', {}) as name:\n"
        "    print(name, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "identifier\n"
        with unused_node_name("identifier", "/killed", {}) as name:
            assert name == "identifier_2"
        other.kill()
    with unused_node_name("identifier", "/killed", {}) as name:
        assert name == "identifier"
