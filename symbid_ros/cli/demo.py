"""``symbid demo``: the whole loop on one machine, from a standing robot to a report."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes.")] = Path("demo"),
    moves: Annotated[int, typer.Option(min=1, max=1000, help="Moves of the centre of mass.")] = 20,
    percent: Annotated[float, typer.Option(min=1, max=99, help="Prior's half-width in %.")] = 25.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the prior and the noise.")] = 0,
    online: Annotated[
        bool,
        typer.Option("--online", help="Identify while the robot moves and show what is known."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the folder of an earlier demo.")
    ] = False,
) -> None:
    """Simulate, publish, record and identify the Symbitron, and report on it."""
    from rich.console import Console

    from symbid_ros.cli.demo_setting import draw_demo_prior, prepare_folder
    from symbid_ros.cli.offline_demo import demonstrate_offline
    from symbid_ros.cli.online_demo import demonstrate_online
    from symbid_ros.package_paths import config_file

    console = Console()
    prepare_folder(out, overwrite=overwrite)
    model = config_file("symbitron.xml")
    draw_demo_prior(out, model, percent, seed)
    demonstrate = demonstrate_online if online else demonstrate_offline
    demonstrate(out, model, moves, seed, console)
    console.print(f"\n[bold]{out}/report.html[/bold] shows it all; the rest of {out}/ made it.")
