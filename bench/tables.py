"""Tables and plots of the benchmarks, and the versions that they are of."""

import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from matplotlib import rcParams
from matplotlib.figure import Figure


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]], digits: int) -> str:
    """Return a table; floating-point numbers get ``digits`` significant digits."""

    def line(cells: Sequence[object]) -> str:
        return f"| {' | '.join(_text(cell, digits) for cell in cells)} |"

    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)])


def _text(cell: object, digits: int) -> str:
    if not isinstance(cell, float):
        return str(cell)
    rounded = float(f"{cell:.{digits}g}")
    return f"{rounded:.0f}" if abs(rounded) >= 10 ** (digits - 1) else f"{rounded:.{digits}g}"


def versions(*packages: str) -> str:
    """Return one line with processor, cores and the versions of packages."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    processor = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "?")
    found = []
    for package in ("symbid_ros", *packages):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} absent")
    cores = len(os.sched_getaffinity(0))
    return f"{processor}, {cores} cores, Python {platform.python_version()}, {', '.join(found)}"


def save_plot(
    path: Path, axis: str, places: Sequence[float], lines: Mapping[str, Sequence[float]]
) -> None:
    """Write an SVG with one panel per line, both axes logarithmic.

    Text stays text, and identifiers do not depend on the run, so that the file is small and changes
    only with the numbers.
    """
    rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "bench"})
    figure = Figure(figsize=(3.4 * len(lines), 2.8), layout="constrained")
    for panel, (name, values) in zip(figure.subplots(1, len(lines)), lines.items(), strict=True):
        panel.loglog(places, values, "o-", color="#1f6f8b")
        panel.set_xlabel(axis)
        panel.set_title(name, fontsize="medium")
        panel.set_xticks(places, [f"{place:g}" for place in places])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    figure.savefig(path, metadata={"Date": None})
