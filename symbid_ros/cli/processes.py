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
from typing import Any

from symbid_ros.errors import SymbidError
from symbid_ros.package_paths import config_file
from symbid_ros.shutdown import unwind

STOPPING_TIME = 120.0  # s; a recorder has to finish its bag, possibly on a busy machine


@contextmanager
def private_graph() -> Iterator[dict[str, str]]:
    """Yield environment variables that isolate nodes in a ROS domain of their own.

    Within the block, SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that nodes in ``with``
    blocks end with the command.
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
    """One node in a process of its own, which ends with the ``with`` block.

    Parameters
    ----------
    name : str
        Module of ``symbid_ros.ros`` whose ``main`` is the node.
    parameters : mapping of str to object
        Node parameters.
    environment : mapping of str to str
        From :func:`private_graph`; nodes with equal environments see each other.
    log : Path
        File for the node's stderr.
    file : str, optional
        File in ``config/`` with the remaining parameters.
    is_shown : bool
        Whether the node prints to the terminal; its summary is then not read.
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
                # Ctrl-C then reaches only the parent, which stops its nodes in order.
                start_new_session=True,
            )

    def __enter__(self) -> "NodeProcess":
        return self

    def __exit__(self, *_: object) -> None:
        if self.running:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.communicate(timeout=STOPPING_TIME)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    def require_running(self) -> None:
        """Raise SymbidError with the node's last line of output if it has ended."""
        if not self.running:
            raise self._failure()

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` seconds for the process to end; return whether it has ended."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self) -> None:
        """Stop the node and wait until it has ended.

        Raises
        ------
        SymbidError
            If the node failed; the message holds its last line of output.
        """
        self._end(STOPPING_TIME, asked=True)

    def finish(self, *, stop: bool = False, patience: float = STOPPING_TIME) -> dict[str, Any]:
        """Wait until the node has ended, and return the summary that it prints.

        Parameters
        ----------
        stop : bool
            Whether to stop it if it is still running.
        patience : float
            Seconds to wait.

        Raises
        ------
        SymbidError
            If the node failed; the message holds its last line of output.
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
                f"{self.name} did not end within {patience:g} s; see {self.log}", "E553"
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
    """Yield one of ``domains`` without participants, and reserve it for the block.

    Other callers of this function get other domains.

    Raises
    ------
    SymbidError
        If all of them are in use.
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
    """Return a socket that reserves a domain, or None if the domain is in use."""
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
    """Return a socket bound to a loopback port, or None if the port is in use."""
    owner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        owner.bind(("127.0.0.1", port))
    except OSError:
        owner.close()
        return None
    return owner
