"""Starts real node processes on a ROS graph of the test's own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import rclpy
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
    def __init__(
        self,
        executable: str,
        env: dict[str, str],
        parameters: dict[str, object],
        namespace: str = "/",
    ) -> None:
        arguments = [
            word
            for name, value in parameters.items()
            for word in ("-p", f"{name}:={str(value).lower() if value in (True, False) else value}")
        ]
        self._process = subprocess.Popen(
            [
                Path(sys.executable).parent / executable,
                "--ros-args",
                "-r",
                f"__ns:={namespace}",
                *arguments,
            ],
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

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
        # Waiting for the end has read the pipes already.
        err = "" if self._process.stderr.closed else self._process.communicate()[1]
        return f"{Path(self._process.args[0]).name} (status {status}): {err[-5000:]}"

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


class Graph:
    """Starts node processes in the test's own domain and observes them from a node."""

    def __init__(self, env: dict[str, str]):
        self._env = env
        self._processes: list[NodeProcess] = []
        self.details: Callable[[], object] = tuple  # its result is printed when a wait fails
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(env["ROS_DOMAIN_ID"]))
        self.node = Node("observer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def start(self, executable: str, namespace: str = "/", **parameters: object) -> NodeProcess:
        self._processes.append(NodeProcess(executable, self._env, parameters, namespace))
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


@pytest.fixture
def graph(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")
    graph = Graph(dict(os.environ))
    try:
        yield graph
    finally:
        graph.close()
