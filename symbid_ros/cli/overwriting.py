"""Checks of output folders: commands replace an earlier result only with --overwrite."""

import shutil
from collections.abc import Callable, Collection
from pathlib import Path

from symbid_ros.errors import SymbidError

_BAG_FILES = {".mcap", ".yaml"}


def require_no_files(out: Path, names: Collection[str], *, overwrite: bool) -> None:
    """Refuse a folder that holds one of these files already, unless they are to be replaced.

    Raises
    ------
    SymbidError
        When one of them is there and ``overwrite`` is false.
    """
    held = [name for name in names if (out / name).exists()]
    if held and not overwrite:
        raise SymbidError(
            f"{out}: holds an earlier {held[0]}; choose another --out, or give --overwrite to "
            "replace it",
            "E551",
        )


def clear_folder(
    out: Path, is_replaceable: Callable[[Path], bool], what: str, *, overwrite: bool
) -> None:
    """Remove the folder of an earlier result, if that is wanted and the folder is one.

    Raises
    ------
    SymbidError
        When something is there that is not ``what``, or ``overwrite`` is false.
    """
    if not (out.exists() or out.is_symlink()):
        return
    if not overwrite:
        raise SymbidError(
            f"{out}: exists; choose another --out, or give --overwrite to replace it", "E551"
        )
    if out.is_symlink() or not out.is_dir() or not is_replaceable(out):
        raise SymbidError(f"{out}: exists and is not {what}; choose another --out", "E551")
    shutil.rmtree(out)


def is_simulated_bag(folder: Path) -> bool:
    """Tell whether a folder holds MCAP files and their metadata and nothing else."""
    suffixes = {file.suffix for file in folder.iterdir()}
    return ".mcap" in suffixes and suffixes <= _BAG_FILES
