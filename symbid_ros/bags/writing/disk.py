"""Disk operations of bag writers: reserve space, sync a folder, create a folder in one step."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from symbid_ros.errors import BagError

STEP = 64 * 1024


class Reserve:
    """Reserves disk space in an unnamed file, which disappears even if the process is killed.

    Parameters
    ----------
    folder : Path
        Folder on the file system to reserve space on.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._held = 0

    def hold(self, size: int) -> None:
        """Reserve at least ``size`` bytes; raise OSError if the disk is too full."""
        if size > self._held:
            held = size + size // 2 + STEP
            os.posix_fallocate(self._file.fileno(), 0, held)
            self._held = held

    def release(self) -> None:
        """Release the space permanently."""
        self._file.close()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary path at which to create a folder; at the end, move it to ``path``.

    An exception leaves nothing behind. A process killed by SIGKILL leaves a hidden folder
    ``.<name>.<random>`` beside ``path``, which does not prevent another attempt.

    Raises
    ------
    BagError
        When ``path`` exists, or its parent is not writable.
    """
    hidden = None
    try:
        if os.path.lexists(path):
            raise BagError(f"{path}: exists already; choose another name or remove it", "E218")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Two levels: mkdtemp makes a private folder, and a bag's files are named after its folder.
        hidden = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name[:32]}."))
        yield hidden / path.name
        (hidden / path.name).rename(path)
        sync_folder(path.parent)
    except OSError as error:
        raise BagError(
            f"{path}: cannot write: {error.strerror}; choose another folder", "E219"
        ) from None
    finally:
        if hidden is not None:
            shutil.rmtree(hidden, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
