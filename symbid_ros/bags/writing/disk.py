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
    """Holds disk space in a file without a name, which not even a kill leaves behind.

    Parameters
    ----------
    folder : Path
        On whose file system the space is held.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._held = 0

    def hold(self, size: int) -> None:
        """Hold at least ``size`` bytes; raise OSError where the disk has no such room."""
        if size > self._held:
            held = size + size // 2 + STEP
            os.posix_fallocate(self._file.fileno(), 0, held)
            self._held = held

    def release(self) -> None:
        """Give the space back, for good."""
        self._file.close()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield where to create a folder that is moved to ``path`` at the end.

    An exception leaves nothing. A process that is killed with SIGKILL leaves a hidden folder
    ``.<name>.<random>`` beside ``path``, which does not prevent another attempt.

    Raises
    ------
    BagError
        When there is something at ``path``, or its parent cannot be written to.
    """
    hidden = None
    try:
        if os.path.lexists(path):
            raise BagError(f"{path}: exists already; choose another name or remove it")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Two levels, because mkdtemp makes a private folder, and bags name files after theirs.
        hidden = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name[:32]}."))
        yield hidden / path.name
        (hidden / path.name).rename(path)
        sync_folder(path.parent)
    except OSError as error:
        raise BagError(f"{path}: cannot write: {error.strerror}; choose another place") from None
    finally:
        if hidden is not None:
            shutil.rmtree(hidden, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Wait until the disk holds the names in a folder."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
