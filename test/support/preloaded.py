"""Starts entry points of the package as processes whose libraries are loaded already.

A node loads libraries for about a second of CPU time. Here a server process loads them once, and
each entry point runs in a fork of it: a process of its own with its own arguments, environment,
signals and exit status. Only an interpreter's start and end are left out;
``test_ros_process.py``, ``test_cli_processes.py`` and tests of signals run the executables.
"""

import faulthandler
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

LIBRARIES = (
    "symbid_ros.cli.app",
    "symbid_ros.cli.tables",
    "symbid_ros.offline.bags",
    "symbid_ros.identification.pipeline",
    "symbid_ros.ros.balance_controller",
    "symbid_ros.ros.identifier",
    "symbid_ros.ros.monitor",
    "symbid_ros.ros.mujoco_bridge",
    "symbid_ros.ros.online_identifier",
    "symbid_ros.ros.player",
    "symbid_ros.ros.recorder",
)
_server = multiprocessing.get_context("forkserver")
_server.set_forkserver_preload(list(LIBRARIES))


class PreloadedProcess:
    """A running entry point, with the methods of :class:`subprocess.Popen` that tests use.

    Parameters
    ----------
    entry : str
        Module and function, such as ``symbid_ros.ros.start:recorder``.
    arguments : sequence of str
        ``sys.argv``.
    environment : mapping of str to str
        The whole environment.
    output : Path
        Stem of the files for stdout and stderr.
    """

    def __init__(
        self, entry: str, arguments: Sequence[str], environment: Mapping[str, str], output: Path
    ) -> None:
        self.args = list(arguments)
        self._files = [output.with_name(f"{output.name}.{name}") for name in ("out", "err")]
        self._process = _server.Process(
            target=_run,
            args=(entry, self.args, dict(environment), os.getcwd(), *map(str, self._files)),
            daemon=True,  # ends with the tests
        )
        self._process.start()

    def poll(self) -> int | None:
        return self._process.exitcode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        out, err = (path.read_text() if path.exists() else "" for path in self._files)
        return out, err

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        if self._process.exitcode is None and self._process.pid is not None:
            os.kill(self._process.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def run_symbid(*arguments: object, output: Path) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own; ``output`` is the stem of the files it prints to."""
    words = ["symbid", *map(str, arguments)]
    process = PreloadedProcess("symbid_ros.cli.main:main", words, os.environ, output)
    out, err = process.communicate()
    return subprocess.CompletedProcess(words, process.returncode or 0, out, err)


def run_script() -> None:
    """Run ``sys.argv[0]`` as ``python`` does; an entry point for :class:`PreloadedProcess`."""
    runpy.run_path(sys.argv[0], run_name="__main__")


def _run(
    entry: str, arguments: list[str], environment: dict[str, str], folder: str, out: str, err: str
) -> None:
    """Run an entry point in this process, which has just been forked."""
    for number, path in ((1, out), (2, err)):
        stream = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(folder)
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    os.environ.update(environment)
    if environment.get("PYTHONFAULTHANDLER"):
        faulthandler.enable()
    sys.argv[:] = arguments
    module, function = entry.split(":")
    getattr(import_module(module), function)()
