"""Outputs are whole or absent: written beside their place, then moved into it."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from symbid_ros.errors import SymbidError


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one step, replacing what was there.

    Surrogates, in which :mod:`symbid_ros.model.xml_edit` keeps bytes that are not UTF-8, become
    those bytes again.

    Raises
    ------
    SymbidError
        When the folder cannot be written to; the old file is then untouched.
    """
    write_through(path, lambda stream: stream.write(text.encode(errors="surrogateescape")))


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
        raise SymbidError(
            f"{path}: cannot write ({error.strerror}); choose another place"
        ) from None
