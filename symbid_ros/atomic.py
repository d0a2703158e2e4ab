"""Outputs are whole or absent: written beside their place, then moved into it."""

import os
import tempfile
from pathlib import Path

from symbid_ros.errors import SymbidError


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one step, replacing what was there.

    Raises
    ------
    SymbidError
        When the folder cannot be written to; the old file is then untouched.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                stream.write(text)
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
