"""Virtual environments with a wheel of this tree and nothing but what the wheel declares.

The dependencies are links to the distributions installed here, so that such an environment takes
seconds and no network, and an import of anything that pyproject.toml does not declare fails in it.
"""

import shutil
import subprocess
import sys
import venv
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("symbid_ros", "config", "launch", "resource")


def build_wheel(folder: Path) -> Path:
    """Build the wheel of a copy of this tree, since setuptools writes into the tree."""
    copy = folder / "source"
    for name in SOURCES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, copy)
    _pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, copy)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path, extras: set[str]) -> Path:
    """Create an environment with the wheel and what it declares; return its folder of scripts."""
    venv.create(folder, symlinks=True, with_pip=False)
    python = folder / "bin" / "python"
    _pip("--python", python, "install", "--no-deps", "--no-index", wheel)
    (site,) = folder.glob("lib/python*/site-packages")
    (built,) = distributions(name="symbid_ros", path=[str(site)])
    for each in _needed(built, extras, {}).values():
        for name in {file.parts[0] for file in each.files or ()} - {"..", "__pycache__"}:
            source, link = Path(str(each.locate_file(name))), site / name
            if source.exists() and not link.exists():
                link.symlink_to(source)
    return python.parent


def _needed(
    dependent: Distribution, extras: set[str], found: dict[str, Distribution]
) -> dict[str, Distribution]:
    """Return the distributions that one requires, directly and through others, by name."""
    for text in dependent.requires or ():
        requirement = Requirement(text)
        marker = requirement.marker
        if marker and not any(marker.evaluate({"extra": extra}) for extra in extras | {""}):
            continue
        name = requirement.name.lower().replace("_", "-")
        if name in found:
            continue
        if name == "symbid-ros":  # an extra that includes another
            _needed(dependent, set(requirement.extras), found)
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError as error:
            raise AssertionError(f"{text}: not installed here") from error
        assert requirement.specifier.contains(found[name].version, prereleases=True), text
        _needed(found[name], set(requirement.extras), found)
    return found


def _pip(*words: object) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
