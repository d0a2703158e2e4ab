"""Where the package's own files (config/, launch/) lie, however it was installed."""

import os
import sys
from pathlib import Path

from symbid_ros.errors import SymbidError

PACKAGE = "symbid_ros"


def share_directory() -> Path:
    """Return the folder that holds ``config/``: the checkout's or the installation's.

    A source tree is preferred, then every prefix of ``AMENT_PREFIX_PATH``
    (colcon, apt), then the virtual environment, which sets no such variable.
    """
    source_tree = Path(__file__).resolve().parents[1]
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    installed = [prefix / "share" / PACKAGE for prefix in [*prefixes, Path(sys.prefix)]]
    for folder in [source_tree, *installed]:
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise SymbidError(
        f"{PACKAGE}: its config/ folder is neither in {source_tree} nor under AMENT_PREFIX_PATH; "
        "install the package again or source its setup.bash"
    )


def config_file(name: str) -> Path:
    """Return the path of one file of ``config/``, checked to exist."""
    path = share_directory() / "config" / name
    if not path.is_file():
        raise SymbidError(f"{path}: no such file in the package's config/; reinstall {PACKAGE}")
    return path
