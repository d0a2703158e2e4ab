"""ROS nodes as child processes: started together, stopped cleanly together."""

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from symbid_ros.errors import SymbidError

STOPPING_TIME = 20.0  # s; a recorder has a bag to complete


def private_domain() -> dict[str, str]:
    """Return an environment in which nodes see one another and nobody else."""
    # Domains above 101 fall into the range of ephemeral ports on Linux.
    domain = {"ROS_DOMAIN_ID": str(random.randint(1, 101))}
    return os.environ | domain | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


class NodeProcess:
    """One node in a process of its own, in a ``with`` block that it does not survive.

    Parameters
    ----------
    name : str
        Module of ``symbid_ros.ros`` whose ``main`` is the node.
    parameters : mapping of str to object
        Node parameters.
    environment : mapping of str to str
        From :func:`private_domain`, the same for all nodes of one graph.
    log : Path
        File for what the node prints to stderr.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: Path,
    ) -> None:
        self.name, self.log = name, log
        assignments = [f"-p {key}:={_yaml(value)}" for key, value in parameters.items()]
        arguments = [word for pair in assignments for word in pair.split(" ", 1)]
        start = f"from symbid_ros.ros.{name} import main; main()"
        with log.open("wb") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-c", start, "--ros-args", *arguments],
                env=dict(environment),
                stdout=subprocess.PIPE,
                stderr=stream,
                # Ctrl-C reaches the parent alone, which stops its nodes in order.
                start_new_session=True,
            )

    def __enter__(self) -> "NodeProcess":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.communicate(timeout=STOPPING_TIME)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()

    @property
    def running(self) -> bool:
        """Whether the process still lives."""
        return self._process.poll() is None

    def wait(self, timeout: float) -> bool:
        """Wait for the process's end at most ``timeout`` seconds and tell whether it came."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def finish(self, *, stop: bool = False) -> dict[str, Any]:
        """Return what the node says of its run once it has ended, asked to ``stop`` or by itself.

        Raises
        ------
        SymbidError
            When the node failed; its last words are in the message.
        """
        if stop and self.running:
            self._process.send_signal(signal.SIGINT)
        output, _ = self._process.communicate(timeout=STOPPING_TIME)
        lines = output.decode().splitlines()
        if self._process.returncode != 0 or not lines:
            words = self.log.read_text(errors="replace").strip().splitlines()
            reason = words[-1] if words else f"exit status {self._process.returncode}"
            raise SymbidError(f"{self.name} failed: {reason} (see {self.log})")
        summary: dict[str, Any] = json.loads(lines[-1])
        return summary


def _yaml(value: object) -> str:
    """Return a parameter's value as the YAML that --ros-args reads; JSON is YAML."""
    return json.dumps(value)
