"""What the terminal says of an estimate."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from symbid_ros.estimation.estimate import Estimate


def print_estimate(estimate: Estimate, out: Path) -> None:
    """Print masses, verdicts and where the files are."""
    console = Console()
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
            link,
            f"{estimate.prior[mass]:.3f}",
            f"{estimate.value[mass]:.3f}",
            std,
            verdicts,
            "yes" if possible else "[red]no[/red]",
        )
    console.print(table)
    cut = "" if estimate.rank is None else f", {estimate.rank} singular values"
    console.print(
        f"{estimate.samples} rows per coordinate{cut}, condition {estimate.condition:.3g}",
        highlight=False,
    )
    console.print(
        f"wrote {out}/estimate.json, model.urdf, model.xml", highlight=False, soft_wrap=True
    )
