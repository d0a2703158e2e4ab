"""The package's own files (config/, launch/) and its version, however it was installed."""

import os
import re
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from xml.etree import ElementTree

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
        "install the package again or source its setup.bash",
        "E550",
    )


def config_file(name: str) -> Path:
    """Return the path of an existing file in ``config/``."""
    path = share_directory() / "config" / name
    if not path.is_file():
        raise SymbidError(
            f"{path}: no such file in the package's config/; reinstall {PACKAGE}", "E550"
        )
    return path


@cache
def package_version() -> str:
    """Return the package's version, which estimates and reports state.

    In a source tree without installed metadata, it is read from package.xml.
    """
    try:
        return version(PACKAGE)
    except PackageNotFoundError:
        pass
    try:
        stated = ElementTree.parse(share_directory() / "package.xml").findtext("version")
    except (SymbidError, OSError, ElementTree.ParseError):
        stated = None
    return stated or "of unknown version"


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Return how to install a missing module, None if none of our extras includes it."""
    name = (error.name or "").partition(".")[0].replace("_", "[-_]")
    try:
        requirements = requires(PACKAGE) or []
    except PackageNotFoundError:
        return None
    for requirement in requirements:
        if found := re.match(rf'(ros-)?{name}\b.*extra == "(\w+)"', requirement, re.IGNORECASE):
            extra = f"{PACKAGE}[{found[2]}]"
            return f"{error.name} is not installed; install it with: pip install '{extra}'"
    return None
