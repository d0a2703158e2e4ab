"""Output files: checks before a computation, and atomic writes.

An atomic write uses a temporary name, then moves the file or folder into place.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from symbid_ros.errors import OptionError, SymbidError
from symbid_ros.shutdown import deferred


def check_writable(folder: Path, file: Path | None = None) -> None:
    """Check that files can be written to a folder, without leaving any behind.

    Commands call this before long computations, so that their results are not lost.

    Parameters
    ----------
    folder : Path
    file : Path, optional
        The only file that will be written, which the error names.

    Raises
    ------
    SymbidError
        If the folder cannot be written to.
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
        raise _cannot_write(file or folder, error) from None
    finally:
        # Another process may have written into the folder since.
        with suppress(OSError):
            for place in reversed(made):
                place.rmdir()


def check_output_folder(folder: Path) -> None:
    """Check that files can be written to a folder that is not a bag.

    Raises
    ------
    SymbidError
        If the folder cannot be written to, or holds the files of a bag.
    """
    check_writable(folder)
    refuse_bag_folder(folder)


def refuse_bag_folder(folder: Path) -> None:
    """Check that a folder is not that of a bag.

    Raises
    ------
    SymbidError
        If it holds the files of one.
    """
    bag = ("metadata.yaml", "*.mcap", "*.db3")
    found = next((file for name in bag for file in folder.glob(name)), None)
    if found is not None:
        raise SymbidError(
            f"{folder}: is the folder of a bag, it holds {found.name}; choose another folder",
            "E551",
        )


def check_output_file(
    path: Path,
    is_replaceable: Callable[[Path], bool],
    remedy: str = "remove it; only earlier output of this command is replaced",
) -> None:
    """Check that a file can be written, without leaving it behind.

    Parameters
    ----------
    path : Path
    is_replaceable : callable
        Returns whether a file that exists may be replaced, such as an earlier output of the same
        format.
    remedy : str
        What the user can do about a file that exists, for the error message.

    Raises
    ------
    SymbidError
        If it cannot be written, or another file is in its place.
    """
    if os.path.isdir(path):
        raise SymbidError(f"{path}: is a folder; name a file in it", "E552")
    if os.path.lexists(path) and not is_replaceable(path):
        raise SymbidError(f"{path}: exists; choose another name, or {remedy}", "E551")
    check_writable(path.parent, path)


def require_distinct(paths: Mapping[str, Path | None]) -> None:
    """Check that the files of a command are different ones, also behind links.

    Parameters
    ----------
    paths : mapping of str to Path or None
        Outputs, and inputs that an output must not replace, by name; options in backquotes.

    Raises
    ------
    OptionError
        If two of them are one file.
    """
    names: dict[str, str] = {}
    for name, path in paths.items():
        if path is None:
            continue
        other = names.setdefault(os.path.realpath(path), name)
        if other != name:
            raise OptionError(
                f"{path}: {other} and {name} are the same file; name different ones", "E502"
            )


def require_no_files(folder: Path, names: Collection[str], *, overwrite: bool) -> None:
    """Check that a folder holds none of the named files, unless they are to be replaced.

    Raises
    ------
    SymbidError
        If it holds one and ``overwrite`` is false.
    """
    present = [name for name in names if (folder / name).exists()]
    if present and not overwrite:
        raise SymbidError(
            f"{folder}: holds an earlier {present[0]}; choose another `out`, or give `overwrite` "
            "to replace it",
            "E551",
        )


def check_replaceable(
    folder: Path, is_replaceable: Callable[[Path], bool], kind: str, *, overwrite: bool
) -> None:
    """Check that a folder is new, or an earlier result that may be replaced.

    Parameters
    ----------
    folder : Path
        Folder of the result; it need not exist.
    is_replaceable : callable
        Returns whether a folder is such a result.
    kind : str
        Name of such a result, for error messages.
    overwrite : bool
        Whether the user allows the replacement.

    Raises
    ------
    SymbidError
        If something else is there, or ``overwrite`` is false.
    """
    if not (folder.exists() or folder.is_symlink()):
        return
    if not overwrite:
        raise SymbidError(
            f"{folder}: exists; choose another --out, or give --overwrite to replace it", "E551"
        )
    if folder.is_symlink() or not folder.is_dir() or not is_replaceable(folder):
        raise SymbidError(f"{folder}: exists and is not {kind}; choose another --out", "E551")


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` atomically, replacing an existing file.

    Surrogates become bytes again: :mod:`symbid_ros.model.xml_file` represents bytes that are not
    UTF-8 by them.

    Raises
    ------
    SymbidError
        If the folder cannot be written to; an existing file is then unchanged.
    """
    write_through(path, lambda stream: stream.write(text.encode(errors="surrogateescape")))


def write_through(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` with a temporary file, then move that file to ``path`` atomically.

    Raises
    ------
    SymbidError
        If the folder cannot be written to; an existing file is then unchanged.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                write(stream)
            # mkstemp creates private files; outputs have the usual permissions.
            os.chmod(name, 0o666 & ~_umask())
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise _cannot_write(path, error) from None


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files are then moved to ``folder`` together.

    A new folder appears atomically. In an existing folder, files are replaced one by one, in
    reverse order of their names, once all are written. A process that is killed while it writes
    leaves the old files unchanged, and a hidden temporary folder.

    Raises
    ------
    SymbidError
        If the folder cannot be written to.
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


@contextmanager
def kept_until_replaced(folder: Path) -> Iterator[None]:
    """Set a folder aside while another is made in its place, then remove it.

    If an exception is raised, the new folder is deleted and the old one is moved back. A process
    that is killed leaves the old one in a hidden folder next to it. If there was no old folder, the
    new one stays.

    Raises
    ------
    SymbidError
        If the folder cannot be moved.
    """
    if not folder.exists():
        yield
        return
    try:
        aside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name[:32]}."))
    except OSError as error:
        raise _cannot_write(folder, error) from None
    earlier = aside / folder.name
    try:
        try:
            folder.rename(earlier)
        except OSError as error:
            raise _cannot_write(folder, error) from None
        yield
    except BaseException:
        with deferred():
            if earlier.exists():
                shutil.rmtree(folder, ignore_errors=True)
                earlier.rename(folder)
            aside.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def _cannot_write(path: Path, error: OSError) -> SymbidError:
    return SymbidError(f"{path}: cannot write ({error.strerror}); choose another place", "E552")
