"""Room on the disk that is kept until a bag is completed."""

import os
import tempfile
from pathlib import Path

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
