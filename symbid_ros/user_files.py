"""Files that users name: regular files only, read within limits."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

MEBI = 1 << 20


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    A device such as /dev/zero would be read for ever, and a pipe without a writer would never
    open.

    Raises
    ------
    OSError
        When it is missing, unreadable, or anything but a regular file; ``strerror`` says which.
    """
    try:
        # Before it is opened, as opening a device may act on it.
        _require_regular(path, os.stat(path))
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    try:
        # It may have been replaced since.
        _require_regular(path, os.fstat(handle))
    except OSError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def read_regular(path: Path, limit: int) -> bytes:
    """Return what a regular file of at most ``limit`` bytes holds.

    Raises
    ------
    OSError
        As :func:`open_regular`.
    ValueError
        When it is larger than ``limit`` bytes.
    """
    with open_regular(path) as stream:
        # The limit may be far larger than the file, and a read allocates all that it asks for.
        size = os.fstat(stream.fileno()).st_size
        content = stream.read(min(size, limit) + 1)
    if len(content) > limit:
        raise ValueError(f"larger than {limit // MEBI} MiB, the limit")
    return content


def _require_regular(path: Path, status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "a folder, not a file", str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
