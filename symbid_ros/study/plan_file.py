"""Plans as YAML files: those that ship, and a user's own."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from symbid_ros.errors import StudyError
from symbid_ros.package_paths import config_file, share_directory
from symbid_ros.safe_yaml import load_yaml
from symbid_ros.study.plan import (
    Accelerations,
    ClosedLoop,
    DataSet,
    Figures,
    Log,
    Part,
    Plan,
    Selection,
    Spread,
    nearest,
)


def load_plan(name: str) -> tuple[Plan, Path]:
    """Read a study that ships with the package, by its name, or a file.

    Returns
    -------
    plan : Plan
    path : Path
        Where it was read.

    Raises
    ------
    StudyError
        When there is no such study or file, or an entry of it is wrong; the message names the
        entry and, where one comes near, what may have been meant.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        known = {file.stem.removeprefix("study_"): file.name for file in studies()}
        if name not in known:
            raise StudyError(
                f"no study {name!r}{nearest(name, known)}; choose one of "
                f"{', '.join(sorted(known))}, or name a YAML file"
            )
        path = config_file(known[name])
    try:
        content = load_yaml(path)
    except OSError as error:
        raise StudyError(
            f"{path}: cannot be read ({error.strerror}); name an existing file"
        ) from None
    except ValueError as error:
        raise StudyError(f"{path}: {error}; correct that line") from None
    if not isinstance(content, dict):
        raise StudyError(f"{path}: no study; begin with title, data and priors")
    try:
        return Plan.model_validate(content), path
    except ValidationError as error:
        # A key of the file may hold a line break.
        fault = " ".join(_first_fault(error, content).split())
        raise StudyError(f"{path}: {fault}") from None


def studies() -> list[Path]:
    """Return the studies that ship with the package."""
    return sorted((share_directory() / "config").glob("study_*.yaml"))


def _first_fault(error: ValidationError, content: dict[str, Any]) -> str:
    """Return the first thing that is wrong, where it is and what may have been meant."""
    faults = error.errors(include_url=False)
    # A misspelt key makes another one missing, too.
    fault = next((one for one in faults if one["type"] == "extra_forbidden"), faults[0])
    where = ".".join(str(step) for step in fault["loc"])
    if fault["type"] == "extra_forbidden":
        fields = _fields_at(fault["loc"][:-1])
        return f"unknown key {where}{nearest(str(fault['loc'][-1]), fields)}; known are " + (
            ", ".join(fields)
        )
    # Of an error that a check of ours raised, pydantic's message begins with "Value error, ".
    message = str(fault.get("ctx", {}).get("error", fault["msg"]))
    return f"{where}: {message}" if where else message


def _fields_at(loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that an entry may have."""
    names: dict[str, type[Part]] = {
        "data": DataSet,
        "validation": Log,
        "equation": Log,
        "logs": Log,
        "priors": Spread,
        "prior": Spread,
        "z": Selection,
        "figures": Figures,
        "accelerations": Accelerations,
        "closed_loop": ClosedLoop,
    }
    found: type[Part] = Plan
    for step in loc:
        found = names.get(str(step), found)
    return list(found.model_fields)
