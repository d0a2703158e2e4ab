"""The files of a study's folder, by which an interrupted study resumes."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from symbid_ros.atomic_write import write_text
from symbid_ros.errors import StudyError
from symbid_ros.package_paths import package_version
from symbid_ros.study.plan import Plan, PriorSpread, SimulatedLog
from symbid_ros.study.sensor_subsets import SensorSubset

Result = TypeVar("Result")


@dataclass(frozen=True)
class StudyFolder:
    """The folder of one study.

    Attributes
    ----------
    out : Path
        Holds the page, tables and figures. Intermediate files are in its folder ``work``.
    """

    out: Path

    @property
    def work(self) -> Path:
        """Folder of logs, rows and draws."""
        return self.out / "work"

    @property
    def earlier(self) -> Path:
        """Folder to which those of an earlier study are moved until this one is complete."""
        return self.out / "work.earlier"

    def reserve(self, plan: Plan, *, overwrite: bool = False) -> None:
        """Mark the folder as this plan's, or check that an earlier run has done so.

        An earlier study that is overwritten comes back if its plan is started again before this
        one is complete.

        Raises
        ------
        StudyError
            If the folder holds other files, or results of another plan or version.
        """
        mark = self.work / "plan.json"
        text = plan.model_dump_json(indent=1) + f"\n{package_version()}\n"
        if mark.is_file() and overwrite:
            if self.earlier.exists():
                shutil.rmtree(self.work)  # an incomplete study
            else:
                self.work.rename(self.earlier)
            write_text(mark, text)
            return
        if mark.is_file():
            if mark.read_text(encoding="utf-8") == text:
                return
            mark = self.earlier / mark.name
            if not mark.is_file() or mark.read_text(encoding="utf-8") != text:
                raise StudyError(
                    f"{self.out}: holds results of another plan or version; choose another --out, "
                    "or give --overwrite to replace them",
                    "E704",
                )
            shutil.rmtree(self.work)
            self.earlier.rename(self.work)
            return
        if self.out.exists() and (not self.out.is_dir() or any(self.out.iterdir())):
            raise StudyError(
                f"{self.out}: is not the folder of a study; choose a new or empty folder as --out",
                "E703",
            )
        write_text(mark, text)

    def complete(self) -> None:
        """Remove an earlier study, once this one is published."""
        shutil.rmtree(self.earlier, ignore_errors=True)

    def log(self, log: SimulatedLog) -> Path:
        """Return the bag of a simulated log."""
        return self.work / "logs" / log.identity

    def tare(self, log: SimulatedLog) -> Path:
        """Return the bag of the same robot, suspended at rest."""
        return self.work / "logs" / f"tare, {log.identity}"

    def robot(self, log: SimulatedLog) -> Path:
        """Return the MJCF file of the simulated robot."""
        return self.work / "logs" / f"{log.identity}.xml"

    def rows(self, log: SimulatedLog, sensors: SensorSubset, cutoff: float | None) -> Path:
        """Return the file of a log's filtered rows; cutoff None: averaged over windows."""
        kind = "windows" if cutoff is None else f"{cutoff:g} Hz"
        return self.work / "rows" / f"{log.identity}, {sensors}, {kind}.npz"

    def draw(self, data: str, spread: PriorSpread, iteration: int) -> Path:
        """Return the file of all methods' results for one draw of the prior."""
        return self.work / "draws" / f"{data}, {spread.kind} {spread.amount:g}, {iteration}.json"

    def loop(self, spread: PriorSpread, iteration: int, method: str) -> Path:
        """Return the file of one closed-loop run."""
        return self.work / "loops" / f"{spread.kind} {spread.amount:g}, {iteration}, {method}.json"

    def check(self, name: str) -> Path:
        """Return the file of one check's results."""
        return self.work / "checks" / f"{name}.json"


def write_result(file: Path, content: object) -> None:
    """Write the result of a task as JSON."""
    write_text(file, json.dumps(content) + "\n")


def read_result(file: Path, parse: Callable[[Any], Result]) -> Result:
    """Return what ``parse`` makes of the JSON in a file.

    Raises
    ------
    StudyError
        If the file is missing or damaged.
    """
    try:
        return parse(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StudyError(
            f"{file}: cannot be read ({error}); delete it and start the study again", "E705"
        ) from None
