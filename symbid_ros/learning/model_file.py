"""A live estimate as a JSON file, for controllers that have no ROS."""

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import write_text
from symbid_ros.errors import DataError, SymbidError
from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.json_documents import VERSIONS, versioned
from symbid_ros.learning.model_update import ModelUpdate
from symbid_ros.simulation.standing_controller import StandingController
from symbid_ros.user_files import load_json

POLL = 0.1  # s; an identifier writes once a second


def write_model(path: Path, candidate: CandidateModel, until: float) -> None:
    """Write a model and what speaks against it, atomically.

    Parameters
    ----------
    path : Path
    candidate : CandidateModel
    until : float
        Stamp of the newest data, s.

    Raises
    ------
    SymbidError
        If the file cannot be written.
    """
    document = {
        "until_s": until,
        "mass_std_kg": candidate.mass_std,
        "com_std_m": candidate.com_std,
        "alarms": list(candidate.alarms),
        "change": candidate.change,
        "links": {
            link: {"phi": _finite(phi), "std": _finite(std)}
            for link, phi, std in zip(candidate.links, candidate.phi, candidate.std, strict=True)
        },
    }
    write_text(path, json.dumps(versioned("live_model", document), indent=1) + "\n")


def read_model(path: Path) -> tuple[CandidateModel, float]:
    """Return the model of a file, and the stamp of its newest data, s.

    Raises
    ------
    DataError
        If the file cannot be read or is not such a document.
    """
    try:
        document = load_json(path)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path", "E531"
        ) from None
    except ValueError as error:
        raise _not_a_model(path, str(error)) from None
    try:
        _check_version(document["schema_version"])
        links = document["links"]
        candidate = CandidateModel(
            tuple(links),
            np.array([_ten_numbers(link["phi"]) for link in links.values()]).reshape(-1, 10),
            np.array([_ten_numbers(link["std"]) for link in links.values()]).reshape(-1, 10),
            tuple(map(str, document["alarms"])),
            mass_std=_number(document["mass_std_kg"]),
            com_std=_number(document["com_std_m"]),
            change=str(document["change"]),
        )
        until = float(document["until_s"])
    except KeyError as error:
        raise _not_a_model(path, f"has no {error}") from None
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise _not_a_model(path, str(error)) from None
    return candidate, until


class ModelFile:
    """Watches an identifier's file, and lets a controller use its models if they can be trusted.

    Parameters
    ----------
    path : Path
        The file need not exist yet.
    controller : StandingController
    largest_change : float
        Largest change of a drive's torque that a model may cause, as a share of its limit.
    report : callable
        Gets a line for each decision, and for a file that cannot be used.

    Raises
    ------
    DataError
        When the file's folder does not exist.
    """

    def __init__(
        self,
        path: Path,
        controller: StandingController,
        largest_change: float,
        report: Callable[[str], object],
    ) -> None:
        if not path.parent.is_dir() or path.is_dir():
            raise DataError(
                f"{path}: no file can appear there; name the file that the identifier writes "
                "(its parameter live_model)",
                "E531",
            )
        self._path, self._report = path, report
        self._models = ModelUpdate(controller, largest_change)
        self._seen: tuple[int, int] | None = None
        self._due = 0.0

    @property
    def counts(self) -> dict[str, int]:
        """Number of decisions of each kind."""
        return self._models.counts

    def update(self) -> None:
        """Judge the newest model if the file has been written since the last call.

        It looks at the file at most once in :data:`POLL` seconds, and costs nothing in between.
        """
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + POLL
        try:
            found = os.stat(self._path)
        except OSError:  # there is no estimate yet
            return
        # A file that is replaced within the resolution of its time has another inode.
        written = found.st_mtime_ns, found.st_ino
        if written == self._seen:
            return
        self._seen = written
        try:
            candidate, until = read_model(self._path)
        except SymbidError as error:
            self._report(f"the identified model is not used: {error}")
            return
        if not candidate.links:
            return
        decision = self._models.judge(candidate, f"identified until {until:.3f} s")
        if decision is not None:
            self._report(decision.message)


def _finite(numbers: FloatArray) -> list[float | None]:
    return [number if math.isfinite(number) else None for number in numbers.tolist()]


def _ten_numbers(values: list[Any]) -> FloatArray:
    if len(values) != 10:
        raise ValueError(f"has {len(values)} parameters of a link, expected 10")
    numbers = [_number(value) for value in values]
    return np.array([math.nan if number is None else number for number in numbers])


def _check_version(version: object) -> None:
    if version != VERSIONS["live_model"]:
        raise ValueError(f"has the version {version!r}")


def _number(value: object) -> float | None:
    """Return a JSON number; None for null, NaN and infinity."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    return float(value) if math.isfinite(value) else None


def _not_a_model(path: Path, reason: str) -> DataError:
    return DataError(
        f"{path}: not the file of an identifier ({reason}); name the one of its parameter "
        "live_model",
        "E531",
    )
