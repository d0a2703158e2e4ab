"""Reading files that users name: regular files only, up to a size limit."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

MEBI = 1 << 20


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Reading a device such as /dev/zero would never end, and opening a pipe without a writer would
    block.

    Raises
    ------
    OSError
        If it is missing, unreadable or not a regular file; ``strerror`` says which.
    """
    try:
        # Checked before opening, as opening a device may have side effects.
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
    """Return the content of a regular file of at most ``limit`` bytes.

    Raises
    ------
    OSError
        As :func:`open_regular`.
    ValueError
        If it is larger than ``limit`` bytes.
    """
    with open_regular(path) as stream:
        # read() allocates as much as it is asked for, and the limit may far exceed the file.
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
