"""``symbid simulate``."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import Progress

Scenario = Literal["smooth", "vibrating", "suspended"]


def simulate(
    out: Annotated[Path, typer.Option(help="Bag folder to write; must not exist.")],
    scenario: Annotated[Scenario, typer.Option(help="Motion to simulate.")] = "smooth",
    moves: Annotated[int, typer.Option(min=1, max=1000, help="Moves of the centre of mass.")] = 20,
    motion_seed: Annotated[int, typer.Option(min=0, help="Seed of the motion.")] = 0,
    noise_seed: Annotated[int, typer.Option(min=0, help="Seed of the sensor noise.")] = 0,
    ideal: Annotated[
        bool, typer.Option("--ideal", help="Same motion, sensors without noise.")
    ] = False,
) -> None:
    """Simulate the Symbitron in MuJoCo and record its sensors and the truth to a bag."""
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import Simulator

    simulator = Simulator(
        scenario, moves=moves, motion_seed=motion_seed, noise_seed=noise_seed, ideal=ideal
    )
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"simulating {scenario}", total=simulator.steps)
        counts = record(
            simulator, out, progress=lambda done, _: progress.update(task, completed=done)
        )
    seconds = simulator.steps * simulator.period_ns * 1e-9
    typer.echo(f"{out}: {seconds:.1f} s, {sum(counts.values())} messages on {len(counts)} topics")
