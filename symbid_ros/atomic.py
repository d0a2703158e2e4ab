"""Outputs are whole or absent: written beside their place, then moved into it."""

import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from symbid_ros.errors import SymbidError


def check_writable(folder: Path) -> None:
    """Try whether files can be written into a folder; nothing is left behind.

    Long work ends with its results on disk, so this is asked before it begins.

    Raises
    ------
    SymbidError
        When they cannot.
    """
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)]
    made: list[Path] = []
    try:
        for place in reversed(missing):
            place.mkdir(exist_ok=True)
            made.append(place)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _refused(folder, error) from None
    finally:
        # Someone else may have put something there meanwhile.
        with suppress(OSError):
            for place in reversed(made):
                place.rmdir()


def check_output_file(path: Path) -> None:
    """Try whether a file can be written; nothing is left behind.

    Raises
    ------
    SymbidError
        When it cannot.
    """
    if path.is_dir():
        raise SymbidError(f"{path}: is a folder; name a file in it")
    check_writable(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one step, replacing what was there.

    Raises
    ------
    SymbidError
        When the folder cannot be written to; the old file is then untouched.
    """
    write_through(path, lambda stream: stream.write(text.encode()))


def write_through(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a file that then takes the place of ``path`` in one step.

    Raises
    ------
    SymbidError
        When the folder cannot be written to; the old file is then untouched.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                write(stream)
            umask = os.umask(0)
            os.umask(umask)
            # mkstemp makes private files; an output is as public as any other.
            os.chmod(name, 0o666 & ~umask)
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise _refused(path, error) from None


def _refused(path: Path, error: OSError) -> SymbidError:
    return SymbidError(f"{path}: cannot write ({error.strerror}); choose another place")
