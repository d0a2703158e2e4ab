"""A study's folder: what has been worked out so far, and where it lies."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from symbid_ros.atomic_write import write_text
from symbid_ros.errors import StudyError
from symbid_ros.package_paths import package_version
from symbid_ros.study.plan import Log, Plan, Spread
from symbid_ros.study.sensor_subsets import Sensing


@dataclass(frozen=True)
class Workspace:
    """The folder of one study.

    Attributes
    ----------
    out : Path
        Results for people lie here, what they are made of in ``work/``.
    """

    out: Path

    @property
    def work(self) -> Path:
        """Logs, rows and draws."""
        return self.out / "work"

    def claim(self, plan: Plan, *, overwrite: bool = False) -> None:
        """Make the folder this study's own, or find that it is.

        Raises
        ------
        StudyError
            When it holds something else, or another study's results.
        """
        mark = self.work / "plan.json"
        text = plan.model_dump_json(indent=1) + f"\n{package_version()}\n"
        if overwrite and mark.is_file():
            shutil.rmtree(self.work)
        if mark.is_file():
            if mark.read_text(encoding="utf-8") != text:
                raise StudyError(
                    f"{self.out}: holds results of another plan or version; choose another --out, "
                    "or --overwrite"
                )
            return
        if self.out.exists() and (not self.out.is_dir() or any(self.out.iterdir())):
            raise StudyError(f"{self.out}: holds something else; choose an empty or new folder")
        write_text(mark, text)

    def log(self, log: Log) -> Path:
        """Return the bag of a simulated log."""
        return self.work / "logs" / log.identity

    def tare(self, log: Log) -> Path:
        """Return the bag of the same robot hanging still."""
        return self.work / "logs" / f"tare, {log.identity}"

    def robot(self, log: Log) -> Path:
        """Return the MJCF of the robot as simulated."""
        return self.work / "logs" / f"{log.identity}.xml"

    def rows(self, log: Log, sensing: Sensing, cutoff: float | None) -> Path:
        """Return the rows of a log behind one filter; None: averaged over windows."""
        kind = "windows" if cutoff is None else f"{cutoff:g} Hz"
        return self.work / "rows" / f"{log.identity}, {sensing}, {kind}.npz"

    def draw(self, data: str, spread: Spread, iteration: int) -> Path:
        """Return the file with what all methods made of one prior."""
        return self.work / "draws" / f"{data}, {spread.kind} {spread.amount:g}, {iteration}.json"

    def loop(self, spread: Spread, iteration: int, method: str) -> Path:
        """Return the file of one run of the controller."""
        return self.work / "loops" / f"{spread.kind} {spread.amount:g}, {iteration}, {method}.json"

    def check(self, name: str) -> Path:
        """Return the file with what one check found."""
        return self.work / "checks" / f"{name}.json"
