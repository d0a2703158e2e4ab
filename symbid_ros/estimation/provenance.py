"""Provenance of a result: its input files with checksums, command, options, versions and date."""

import hashlib
import math
import platform
import shlex
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from symbid_ros.options import options_of
from symbid_ros.package_paths import PACKAGE, package_version
from symbid_ros.user_files import open_regular

# Libraries that results depend on, as modules; those that are not loaded had no part in it.
LIBRARIES = ("numpy", "scipy", "llvmlite", "clarabel", "mujoco", "mcap", "rosbags", "apsw")
CHUNK = 1 << 20  # bytes; hashing one releases the interpreter for about a millisecond


@dataclass(frozen=True)
class InputFile:
    """A file that an identification read.

    Attributes
    ----------
    path : str
        As the user gave it; for a bag's folder, the path of each file in it.
    sha256 : str or None
        Checksum in hexadecimal; None if the file could not be read.
    size_bytes : int or None
        None if the file could not be read.
    """

    path: str
    sha256: str | None
    size_bytes: int | None


@dataclass(frozen=True)
class Provenance:
    """Where a result comes from.

    Attributes
    ----------
    inputs : tuple of InputFile
        Each file of the bags, the model with the files that it includes, and the files that
        options name.
    command : str
        The command line; empty in Python.
    options : dict of str to object
        The value of every option, defaults included, as JSON values.
    versions : dict of str to str
        Of this package, Python and the libraries that were used.
    date : str
        Time of the identification, ISO 8601 in UTC.
    """

    inputs: tuple[InputFile, ...] = ()
    command: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    date: str = ""

    @classmethod
    def now(cls, inputs: tuple[InputFile, ...], options: Any, command: str = "") -> "Provenance":
        """Return the provenance of an identification with a dataclass of options, made now."""
        date = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(inputs, command, option_values(options), library_versions(), date)

    def extended(
        self, command: str, files: Iterable[Path], options: Mapping[str, Any]
    ) -> "Provenance":
        """Return it with the command, and further input files and options of a front end."""
        added = tuple(map(digest, list_inputs(files)))
        return replace(
            self,
            inputs=(*self.inputs, *added),
            command=command,
            options=self.options | dict(options),
        )


class InputDigests:
    """Checksums of input files, computed by a thread while the files are read and used.

    Hashing releases the interpreter, so it runs beside the computation.

    Parameters
    ----------
    paths : iterable of Path
        Files and folders of bags; those that do not exist are left out.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = list_inputs(paths)
        self._found: list[InputFile] = []
        # As a daemon, so that an error or Ctrl-C does not wait for the files.
        self._thread = threading.Thread(target=self._run, name="input digests", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._found.extend(map(digest, self._paths))

    def wait(self) -> tuple[InputFile, ...]:
        """Return the files with their checksums when all are computed."""
        self._thread.join()
        return tuple(self._found)


def list_inputs(paths: Iterable[Path]) -> list[Path]:
    """Return the existing files among ``paths`` once each, and the visible files of folders."""
    found: dict[Path, None] = {}
    for path in paths:
        files = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
        found |= dict.fromkeys(file for file in files if file.is_file())
    return list(found)


def digest(path: Path) -> InputFile:
    """Return a file with its SHA-256 and size."""
    checksum, size = hashlib.sha256(), 0
    try:
        with open_regular(path) as stream:
            while chunk := stream.read(CHUNK):
                checksum.update(chunk)
                size += len(chunk)
    except OSError:
        return InputFile(str(path), None, None)
    return InputFile(str(path), checksum.hexdigest(), size)


def command_line() -> str:
    """Return the command that runs, as the user could repeat it in a shell."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def option_values(options: Any) -> dict[str, Any]:
    """Return the options of a dataclass as JSON values."""
    return {one.name: _json_value(getattr(options, one.name)) for one in options_of(type(options))}


def _json_value(value: Any) -> Any:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_json_value(one) for one in value]
    if isinstance(value, Mapping):  # a prior
        return {str(name): _json_value(one) for name, one in value.items()}
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    # Paths, infinite numbers, and logs of arrays, which have a name.
    return str(getattr(value, "source", value))


def library_versions() -> dict[str, str]:
    """Return the versions of this package, Python and the libraries that are loaded."""
    versions = {PACKAGE: package_version(), "python": platform.python_version()}
    for name in LIBRARIES:
        if name in sys.modules:
            try:
                versions[name] = version(name)
            except PackageNotFoundError:  # installed by other means than pip
                versions[name] = str(getattr(sys.modules[name], "__version__", "unknown"))
    return versions
