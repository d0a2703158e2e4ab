"""Starts nodes as processes on a ROS graph of the test's own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
import rclpy
from preloaded import PreloadedProcess
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

DEADLINE = 300.0  # s; long enough for a busy machine; only a hang takes longer


@dataclass(frozen=True)
class Ended:
    status: int
    out: str
    err: str


class NodeProcess:
    def __init__(self, process: "PreloadedProcess | subprocess.Popen[str]") -> None:
        self._process = process

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def ended(self) -> Ended:
        out, err = self._process.communicate(timeout=DEADLINE)
        return Ended(self._process.returncode, out, err)

    def aborted(self) -> str:
        """End the process and return its status and the end of its stderr."""
        status = self._process.poll()
        if status is None:
            self._process.send_signal(signal.SIGABRT)  # prints the stack of each thread
        try:
            err = self._process.communicate()[1]
        except ValueError:  # waiting for the end has read the pipes already
            err = ""
        return f"{Path(self._process.args[0]).name} (status {status}): {err[-5000:]}"

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


class Graph:
    """Starts node processes in the test's own domain and observes them from a node."""

    def __init__(self, env: dict[str, str], outputs: Path):
        self._env, self._outputs = env, outputs
        self._processes: list[NodeProcess] = []
        self.details: Callable[[], object] = tuple  # its result is printed when a wait fails
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(env["ROS_DOMAIN_ID"]))
        self.node = Node("observer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def start(self, executable: str, namespace: str = "/", **parameters: object) -> NodeProcess:
        """Start a node whose libraries are loaded already."""
        process = PreloadedProcess(
            f"symbid_ros.ros.start:{executable}",
            _words(executable, namespace, parameters),
            self._env,
            self._outputs / f"{len(self._processes)}_{executable}",
        )
        return self._keep(process)

    def execute(self, executable: str, namespace: str = "/", **parameters: object) -> NodeProcess:
        """Start the executable itself, as ``ros2 run`` does; its end includes the interpreter's."""
        process = subprocess.Popen(
            _words(str(Path(sys.executable).parent / executable), namespace, parameters),
            env=self._env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        return self._keep(process)

    def _keep(self, process: "PreloadedProcess | subprocess.Popen[str]") -> NodeProcess:
        self._processes.append(NodeProcess(process))
        return self._processes[-1]

    def wait_until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, self._describe_failure()
            self._executor.spin_once(timeout_sec=0.02)

    def wait_for_node(self, name: str) -> None:
        self.wait_until(lambda: name in self.node.get_node_names())

    def _describe_failure(self) -> str:
        """End the nodes and return what they have printed."""
        reports = [process.aborted() for process in self._processes]
        return "\n".join(["the condition was not met in time", str(self.details()), *reports])

    def close(self) -> None:
        for process in self._processes:
            process.kill()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


def _words(executable: str, namespace: str, parameters: Mapping[str, object]) -> list[str]:
    """Return the command line of a node."""
    words = [executable, "--ros-args", "-r", f"__ns:={namespace}"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={str(value).lower() if value in (True, False) else value}"]
    return words


@pytest.fixture
def graph(
    domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Graph]:
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")
    graph = Graph(dict(os.environ), tmp_path_factory.mktemp("nodes"))
    try:
        yield graph
    finally:
        graph.close()
