"""Outputs are whole or absent: written beside their place, then moved into it."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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
        raise _cannot_write(folder, error) from None
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
        raise SymbidError(f"{path}: is a folder; name a file in it", "E552")
    check_writable(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one step, replacing what was there.

    Surrogates, in which :mod:`symbid_ros.model.xml_file` keeps bytes that are not UTF-8, become
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
            # mkstemp makes private files; an output is as public as any other.
            os.chmod(name, 0o666 & ~_umask())
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise _cannot_write(path, error) from None


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files then appear in ``folder`` together.

    A new folder appears in one step. In one that exists, each file replaces its predecessor, in
    reverse order of their names and only once all are written. A process that is killed while it
    writes leaves the old files as they were, beside a hidden folder.

    Raises
    ------
    SymbidError
        When the folder cannot be written to.
    """
    is_new = not folder.exists()
    try:
        if is_new:
            folder.parent.mkdir(parents=True, exist_ok=True)
        place = folder.parent if is_new else folder
        stage = Path(tempfile.mkdtemp(dir=place, prefix=f".{folder.name}."))
    except OSError as error:
        raise _cannot_write(folder, error) from None
    try:
        yield stage
        if is_new and any(stage.iterdir()):
            stage.chmod(0o777 & ~_umask())
            stage.rename(folder)
        elif not is_new:
            for path in sorted(filter(Path.is_file, stage.rglob("*")), reverse=True):
                target = folder / path.relative_to(stage)
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
    except OSError as error:
        raise _cannot_write(folder, error) from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def _cannot_write(path: Path, error: OSError) -> SymbidError:
    return SymbidError(f"{path}: cannot write ({error.strerror}); choose another place", "E552")
