"""ROS nodes as child processes: started together, stopped cleanly together."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from symbid_ros.errors import SymbidError
from symbid_ros.package_paths import config_file
from symbid_ros.shutdown import unwind

STOPPING_TIME = 120.0  # s; a recorder has a bag to complete, perhaps on a machine that is busy


@contextmanager
def private_graph() -> Iterator[dict[str, str]]:
    """Yield an environment in which nodes see one another and nobody else.

    As long as it lasts, SIGTERM and SIGHUP unwind the stack as Ctrl-C does: nodes in ``with``
    blocks do not outlive the command.
    """
    numbers = signal.SIGTERM, signal.SIGHUP
    before = {number: signal.signal(number, unwind) for number in numbers}
    try:
        with unused_domain() as domain:
            yield os.environ | {
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            }
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class NodeProcess:
    """One node in a process of its own, in a ``with`` block that it does not survive.

    Parameters
    ----------
    name : str
        Module of ``symbid_ros.ros`` whose ``main`` is the node.
    parameters : mapping of str to object
        Node parameters.
    environment : mapping of str to str
        From :func:`private_graph`, the same for all nodes of one graph.
    log : Path
        File for what the node prints to stderr.
    file : str, optional
        Of ``config/``: the parameters that are not given.
    is_shown : bool
        Whether the node prints to the terminal instead of telling of its run at the end.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: Path,
        *,
        file: str | None = None,
        is_shown: bool = False,
    ) -> None:
        self.name, self.log = name, log
        arguments = ["--params-file", str(config_file(file))] if file else []
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={_yaml(value)}"]
        start = f"from symbid_ros.ros.start import {name}; {name}()"
        with log.open("wb") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-c", start, "--ros-args", *arguments],
                env=dict(environment),
                stdout=None if is_shown else subprocess.PIPE,
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
        if self.running:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.communicate(timeout=STOPPING_TIME)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process still lives."""
        return self._process.poll() is None

    def require_running(self) -> None:
        """Raise SymbidError, with the node's last words, when it has ended."""
        if not self.running:
            raise self._failure()

    def wait(self, timeout: float) -> bool:
        """Wait for the process's end at most ``timeout`` seconds and tell whether it came."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self) -> None:
        """Ask the node to end and wait until it has.

        Raises
        ------
        SymbidError
            When the node failed; its last words are in the message.
        """
        self._end(STOPPING_TIME, asked=True)

    def finish(self, *, stop: bool = False, patience: float = STOPPING_TIME) -> dict[str, Any]:
        """Return what the node says of its run once it has ended, asked to ``stop`` or by itself.

        Parameters
        ----------
        stop : bool
            Whether to ask it to end, if it still runs.
        patience : float
            Seconds that it may take.

        Raises
        ------
        SymbidError
            When the node failed; its last words are in the message.
        """
        lines = self._end(patience, asked=stop)
        if not lines:
            raise self._failure()
        summary: dict[str, Any] = json.loads(lines[-1])
        return summary

    def _end(self, patience: float, *, asked: bool) -> list[str]:
        if asked and self.running:
            self._process.send_signal(signal.SIGINT)
        try:
            output, _ = self._process.communicate(timeout=patience)
        except subprocess.TimeoutExpired:
            raise SymbidError(
                f"{self.name} does not end within {patience:g} s; see {self.log}", "E553"
            ) from None
        if self._process.returncode != 0:
            raise self._failure()
        return output.decode().splitlines() if output else []

    def _failure(self) -> SymbidError:
        words = self.log.read_text(errors="replace").strip().splitlines()
        status = self._process.returncode
        reason = words[-1] if words else f"killed by signal {-status}"
        if not words and status >= 0:
            reason = f"exit status {status}"
        return SymbidError(f"{self.name} failed: {reason} (see {self.log})", "E553")


def _yaml(value: object) -> str:
    """Return a parameter's value as the YAML that --ros-args reads; JSON is YAML."""
    return json.dumps(value)


DOMAINS = range(1, 102)  # above lie the ephemeral ports of Linux
# Ports of RTPS 2.5, 9.6.2.3: a participant listens at FIRST + DOMAIN · domain + 10 + 2 · number.
FIRST, DOMAIN = 7400, 250
PARTICIPANT, PARTICIPANTS = 10, 20
MARK = 2  # no participant uses this one


@contextmanager
def unused_domain(domains: Sequence[int] = DOMAINS) -> Iterator[int]:
    """Yield one of ``domains`` in which no participant listens, for as long as the block lasts.

    Whoever else asks this function meanwhile gets another one.

    Raises
    ------
    SymbidError
        When all of them are in use.
    """
    for domain in random.sample(domains, len(domains)):
        mark = _marked(domain)
        if mark is not None:
            with closing(mark):
                yield domain
            return
    raise SymbidError(
        f"each of {len(domains)} ROS domains is in use on this machine; end some of its nodes",
        "E554",
    )


def _marked(domain: int) -> socket.socket | None:
    """Return a socket that marks a domain as taken, or None if it already is."""
    base = FIRST + DOMAIN * domain
    mark = _bound(base + MARK)
    if mark is None:
        return None
    for number in range(PARTICIPANTS):
        probe = _bound(base + PARTICIPANT + 2 * number)
        if probe is None:
            mark.close()
            return None
        probe.close()
    return mark


def _bound(port: int) -> socket.socket | None:
    """Return a socket that owns a port of loopback, or None if another does."""
    owner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        owner.bind(("127.0.0.1", port))
    except OSError:
        owner.close()
        return None
    return owner
