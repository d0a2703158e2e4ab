"""What the terminal says of an estimate."""

from pathlib import Path

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.verdict import Verdict


def print_estimate(estimate: Estimate, out: Path) -> None:
    """Print alarms, masses, verdicts and where the files are.

    Parameters
    ----------
    estimate : Estimate
        What was found.
    out : Path
        Folder that its files were written to.
    """
    console = Console(highlight=False)
    # Long lines are left to the terminal to wrap: whoever reads them from a pipe gets them whole.
    for alarm in estimate.verdict.alarms if estimate.verdict is not None else ():
        console.print(Text(f"alarm: {alarm}", style="bold red"), soft_wrap=True)
    console.print(links_table(estimate))
    for line in _lines(estimate, out):
        console.print(line, soft_wrap=True)


def links_table(estimate: Estimate) -> Table:
    """Return mass, count of determined parameters and possibility of every link."""
    table = Table(title=f"{estimate.model}, {estimate.method}", title_justify="left")
    table.add_column("link")
    for header in ("prior kg", "mass kg", "± kg", "determined", "possible"):
        table.add_column(header, justify="right")
    position = {name: index for index, name in enumerate(estimate.names)}
    for link, possible in estimate.consistent.items():
        mass = position[f"{link}/m"]
        verdicts = "–"
        if estimate.determined is not None:
            verdicts = f"{int(estimate.determined[mass : mass + 10].sum())} of 10"
        std = "–" if estimate.std is None else f"{estimate.std[mass]:.3f}"
        table.add_row(
            Text(link),
            f"{estimate.prior[mass]:.3f}",
            f"{estimate.value[mass]:.3f}",
            std,
            verdicts,
            "yes" if possible else Text("no", style="red"),
        )
    return table


def _lines(estimate: Estimate, out: Path) -> list[RenderableType]:
    verdict = estimate.verdict
    windows = ""
    if verdict is not None and verdict.window > 0:
        windows = f", averaged over windows of {1e3 * verdict.window:g} ms"
    cut = "" if estimate.rank is None else f", {estimate.rank} singular values"
    lines: list[RenderableType] = [
        f"{estimate.samples} rows of each coordinate{windows}{cut}, condition "
        f"{estimate.condition:.3g}"
    ]
    if verdict is not None:
        lines += _verdict_lines(verdict, len(estimate.names))
    files = "estimate.json, information.npz, model.urdf, model.xml"
    return [*lines, Text(f"wrote {out}/: {files}")]


def _verdict_lines(verdict: Verdict, parameters: int) -> list[RenderableType]:
    lines: list[RenderableType] = [
        f"{len(verdict.directions)} of {parameters} directions determined, "
        f"{verdict.gain:.0f} bit gained"
    ]
    if verdict.sensors:
        known = sum(error.determined for error in verdict.sensors)
        lines.append(f"{known} of {len(verdict.sensors)} sensor errors determined")
    if not verdict.alarms:
        return [*lines, Text("no alarm", style="green")]
    count = len(verdict.alarms)
    told = "1 alarm" if count == 1 else f"{count} alarms"
    return [*lines, Text(f"{told}: do not trust these numbers yet", style="bold red")]
