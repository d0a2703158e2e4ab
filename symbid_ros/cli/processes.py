"""ROS nodes as child processes, in a ROS domain of their own."""

import errno
import hashlib
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from symbid_ros.errors import SymbidError
from symbid_ros.package_paths import config_file
from symbid_ros.shutdown import deferred, exit_on_signals

# A node's own error, without which it ends only if it crashes.
FAILURE = re.compile(r"(?P<name>\w+): (?P<text>.*) \(SYMBID-(?P<code>E\d+)\)")
STOPPING_TIME = 120.0  # s; a recorder has to finish its bag, possibly on a busy machine


@contextmanager
def private_graph() -> Iterator[dict[str, str]]:
    """Yield environment variables that isolate nodes in a ROS domain of their own.

    From then on SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that nodes in ``with``
    blocks end with the command.
    """
    exit_on_signals()
    with unused_domain() as domain:
        yield os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }


class NodeProcess:
    """A node in a child process, which ends with the ``with`` block, or with this process.

    Create it in a thread that lives as long as the node, such as the main thread.

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
    remapped : mapping of str to str, optional
        Remapping rules, such as another ``__node`` or ``__ns``.
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
        remapped: Mapping[str, str] | None = None,
        is_shown: bool = False,
    ) -> None:
        self.name, self.log = name, log
        arguments = ["--params-file", str(config_file(file))] if file else []
        for old, new in (remapped or {}).items():
            arguments += ["-r", f"{old}:={new}"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={json.dumps(value)}"]  # read as YAML, which includes JSON
        start = (
            f"from symbid_ros.ros.start import {name}; from symbid_ros.shutdown import "
            f"end_with_parent; end_with_parent({os.getpid()}); {name}()"
        )
        try:
            # A signal's exception inside Popen would leave a process that nobody ends.
            with log.open("wb") as stream, deferred():
                self._process = subprocess.Popen(
                    [sys.executable, "-c", start, "--ros-args", *arguments],
                    env=dict(environment),
                    stdout=None if is_shown else subprocess.PIPE,
                    stderr=stream,
                    # Ctrl-C then reaches only the parent, which stops its nodes in order.
                    start_new_session=True,
                )
        except (KeyboardInterrupt, SystemExit):
            self.__exit__()
            raise

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

    @property
    def was_interrupted(self) -> bool:
        """Whether a signal ended the process while it was starting."""
        return self._process.poll() in (128 + signal.SIGINT, -signal.SIGINT)

    @property
    def was_killed(self) -> bool:
        """Whether a signal ended the process that it did not handle."""
        return (self._process.poll() or 0) < 0

    def require_running(self) -> None:
        """Raise SymbidError with the node's last line of output if it has ended."""
        if not self.running:
            raise self._failure()

    def first_line(self) -> str:
        """Wait for the first line that the node prints, and return it.

        Raises
        ------
        SymbidError
            If the node ended before; the message holds its last line of output.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline().decode().strip()
        if not line:
            self._process.wait(STOPPING_TIME)
            raise self._failure()
        return line

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
        if self.was_killed:  # its last line tells nothing about that
            number = -self._process.returncode
            cause = ", perhaps for want of memory" if number == signal.SIGKILL else ""
            return SymbidError(
                f"{self.name} was killed by signal {number}{cause} (see {self.log})", "E553"
            )
        lines = self.log.read_text(errors="replace").strip().splitlines()
        error = FAILURE.fullmatch(lines[-1]) if lines else None
        if error is not None and error["name"] == self.name:
            return SymbidError(f"{error['text']} (see {self.log})", error["code"])
        reason = lines[-1] if lines else f"exit status {self._process.returncode}"
        return SymbidError(f"{self.name} failed: {reason} (see {self.log})", "E553")


@contextmanager
def unused_node_name(name: str, namespace: str, environment: Mapping[str, str]) -> Iterator[str]:
    """Yield the name, or a variant of it if a node in the namespace has it already.

    Other callers of this function on the machine get other names during the block, because a
    node appears in the ROS graph only seconds after its start.
    """
    used = _node_names(name, namespace, environment)
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    for number in count(1):
        variant = f"{name}_{number}" if number > 1 else name
        if variant in used:
            continue
        reservation = _reserve_name(f"{domain} {namespace} {variant}")
        if reservation is not None:
            with closing(reservation):
                yield variant
            return


def _node_names(name: str, namespace: str, environment: Mapping[str, str]) -> set[str]:
    """Return the names of running nodes; empty if nodes cannot be started, which say why."""
    found = subprocess.run(
        [sys.executable, "-m", "symbid_ros.ros.node_names", name, namespace],
        check=False,
        env=dict(environment),
        capture_output=True,
        text=True,
    )
    return set(found.stdout.split())


def _reserve_name(text: str) -> socket.socket | None:
    """Return a socket that reserves a text on this machine, or None if it is reserved already.

    The socket has no file: Linux removes it with its process, also if that is killed.
    """
    reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        # The name of a socket has at most 107 characters.
        reservation.bind("\0symbid_ros " + hashlib.sha256(text.encode()).hexdigest())
    except OSError as error:
        reservation.close()
        if error.errno != errno.EADDRINUSE:
            raise
        return None
    return reservation


DOMAINS = range(1, 102)  # higher domains use the ephemeral ports of Linux
# Ports of RTPS 2.5, 9.6.2.3: a participant listens at PORT_BASE + DOMAIN_GAIN · domain
# + PARTICIPANT_OFFSET + PARTICIPANT_GAIN · participant.
PORT_BASE, DOMAIN_GAIN = 7400, 250
PARTICIPANT_OFFSET, PARTICIPANT_GAIN = 10, 2
PARTICIPANTS = 20  # checked for each domain
RESERVATION_OFFSET = 2  # no participant uses this port


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
        reservation = _reserve(domain)
        if reservation is not None:
            with closing(reservation):
                yield domain
            return
    raise SymbidError(
        f"each of {len(domains)} ROS domains is in use on this machine; end some of its nodes",
        "E554",
    )


def _reserve(domain: int) -> socket.socket | None:
    """Return a socket that reserves a domain, or None if the domain is in use."""
    base = PORT_BASE + DOMAIN_GAIN * domain
    reservation = _bind(base + RESERVATION_OFFSET)
    if reservation is None:
        return None
    for participant in range(PARTICIPANTS):
        probe = _bind(base + PARTICIPANT_OFFSET + PARTICIPANT_GAIN * participant)
        if probe is None:
            reservation.close()
            return None
        probe.close()
    return reservation


def _bind(port: int) -> socket.socket | None:
    """Return a socket bound to a loopback port, or None if the port is in use."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("127.0.0.1", port))
    except OSError:
        bound.close()
        return None
    return bound
