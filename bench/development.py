"""Checks that the packages of `make setup-dev` are there before a benchmark begins."""

from importlib.metadata import PackageNotFoundError, version

EXAMPLE_ROBOTS = "example-robot-data"


def require_packages(*names: str) -> None:
    """End the program with one line if one of these packages is not installed."""
    missing = [name for name in names if not _is_installed(name)]
    if missing:
        raise SystemExit(f"{', '.join(missing)} not installed; run `make setup-dev`")


def _is_installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True
