"""A new bag's folder, which is there as a whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from symbid_ros.bags.writing.segment import sync_folder
from symbid_ros.errors import BagError


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
