"""YAML files of numbers, checked entry by entry."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from symbid_ros.errors import SimulationError
from symbid_ros.safe_yaml import load_yaml


def read_mapping(path: Path) -> dict[str, Any]:
    """Return a file's YAML mapping.

    Raises
    ------
    SimulationError
        When the file is missing or holds anything else.
    """
    try:
        content = load_yaml(path)
    except OSError as error:
        raise SimulationError(
            f"{path}: cannot be read ({error.strerror}); name an existing file"
        ) from None
    except ValueError as error:
        raise SimulationError(f"{path}: {error}; correct that line") from None
    if not isinstance(content, dict):
        raise SimulationError(f"{path}: not a mapping; give one line 'name: value' for each entry")
    return {str(name): value for name, value in content.items()}


def numbers(content: object, names: Sequence[str], where: str) -> dict[str, float]:
    """Return the named entries of a mapping, each checked to be a finite number, 0 or more.

    Raises
    ------
    SimulationError
        When an entry is missing, unknown or no such number; the message begins with ``where``.
    """
    if not isinstance(content, dict):
        raise SimulationError(f"{where}: not a mapping; give {', '.join(names)}")
    missing = [name for name in names if name not in content]
    if missing:
        raise SimulationError(f"{where}: {', '.join(missing)} missing; give 0 for none")
    unknown = [str(name) for name in content if name not in names]
    if unknown:
        raise SimulationError(f"{where}: unknown entry {', '.join(unknown)}; remove it")
    return {name: _number(content[name], name, where) for name in names}


def _number(value: object, name: str, where: str) -> float:
    # YAML reads "yes" as a boolean, which Python would take for the number 1.
    if isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and number >= 0.0:
            return number
    raise SimulationError(f"{where}: {name} is {value!r}; give a finite number, 0 or more")
