"""SQLite files that were cut off within a page."""

from pathlib import Path
from typing import Any

import apsw


class WholePages(apsw.VFS):
    """Reads a database as if it ended with its last whole page.

    SQLite would read what is missing of a page that was cut off as zeros.
    """

    def __init__(self, base: str, file: Path) -> None:
        with file.open("rb") as stream:
            size = int.from_bytes(stream.read(18)[16:], "big")
        self.name = f"whole pages {id(self)}"
        self._base, self._page = base, 65536 if size == 1 else max(size, 1)
        super().__init__(self.name, base)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:
        """Open one of SQLite's files."""
        page = self._page if flags[0] & apsw.SQLITE_OPEN_MAIN_DB else 1
        return _WholePagesFile(self._base, name, flags, page)


class _WholePagesFile(apsw.VFSFile):
    def __init__(self, base: str, name: Any, flags: list[int], page: int) -> None:
        self._page = page
        super().__init__(base, name, flags)

    def xFileSize(self) -> int:
        """Return the size in bytes."""
        size = super().xFileSize()
        return size - size % self._page
