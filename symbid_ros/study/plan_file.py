"""Plans as YAML files: those that ship with the package, and a user's own."""

from pathlib import Path

from pydantic import ValidationError

from symbid_ros.errors import StudyError
from symbid_ros.package_paths import config_file, share_directory
from symbid_ros.study.plan import (
    AccelerationPlan,
    ClosedLoopPlan,
    DataSet,
    FigurePlan,
    Plan,
    PlanEntry,
    PriorSpread,
    RankSelection,
    SimulatedLog,
    did_you_mean,
)
from symbid_ros.user_files import load_yaml


def load_plan(name: str) -> tuple[Plan, Path]:
    """Read a study that ships with the package, by its name, or a file.

    Returns
    -------
    plan : Plan
    path : Path
        The file that was read.

    Raises
    ------
    StudyError
        If the study or file does not exist, or an entry is invalid. The message names the entry
        and suggests the most similar known name.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        known = {file.stem.removeprefix("study_"): file.name for file in shipped_studies()}
        if name not in known:
            raise StudyError(
                f"unknown study {name!r}{did_you_mean(name, known)}; choose one of "
                f"{', '.join(sorted(known))}, or give a .yaml file",
                "E701",
            )
        path = config_file(known[name])
    try:
        content = load_yaml(path)
    except OSError as error:
        raise StudyError(
            f"{path}: cannot be read ({error.strerror}); give an existing file", "E701"
        ) from None
    except ValueError as error:
        raise StudyError(f"{path}: {error}; correct that line", "E702") from None
    if not isinstance(content, dict):
        raise StudyError(f"{path}: not a study; start with title, data and priors", "E702")
    try:
        return Plan.model_validate(content), path
    except ValidationError as error:
        # A key of the file may hold a line break.
        fault = " ".join(_first_fault(error).split())
        raise StudyError(f"{path}: {fault}", "E702") from None


def shipped_studies() -> list[Path]:
    """Return the files of the studies that ship with the package."""
    return sorted((share_directory() / "config").glob("study_*.yaml"))


def _first_fault(error: ValidationError) -> str:
    """Return the first fault: the entry, the reason and a suggestion."""
    faults = error.errors(include_url=False)
    # A misspelt key also makes the correct one missing, so it is reported first.
    fault = next((one for one in faults if one["type"] == "extra_forbidden"), faults[0])
    where = ".".join(str(step) for step in fault["loc"])
    if fault["type"] == "extra_forbidden":
        fields = _known_keys(fault["loc"][:-1])
        suggestion = did_you_mean(str(fault["loc"][-1]), fields)
        return f"unknown key {where}{suggestion}; known keys are {', '.join(fields)}"
    # Pydantic puts "Value error, " before the messages of our own validators.
    message = str(fault.get("ctx", {}).get("error", fault["msg"]))
    return f"{where}: {message}" if where else message


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the entry at ``loc`` may have."""
    names: dict[str, type[PlanEntry]] = {
        "data": DataSet,
        "validation": SimulatedLog,
        "equation": SimulatedLog,
        "logs": SimulatedLog,
        "priors": PriorSpread,
        "prior": PriorSpread,
        "z": RankSelection,
        "figures": FigurePlan,
        "accelerations": AccelerationPlan,
        "closed_loop": ClosedLoopPlan,
    }
    found: type[PlanEntry] = Plan
    for step in loc:
        found = names.get(str(step), found)
    return list(found.model_fields)
