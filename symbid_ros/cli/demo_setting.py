"""What both demos set up: a folder, a prior off the truth, and an ideal bag to judge by."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from symbid_ros.cli.overwriting import clear_folder

MOTION_SEED, VALIDATION_SEED = 1, 2


def progress_bars(console: Console) -> Progress:
    """Return the bars that a demo shows its stages with."""
    return Progress(
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
        console=console,
    )


def prepare_folder(out: Path, *, overwrite: bool) -> None:
    """Make an empty folder, in place of an earlier demo's only if that is wanted."""
    clear_folder(
        out,
        lambda folder: (folder / "prior.json").is_file(),
        "the folder of a demo",
        overwrite=overwrite,
    )
    out.mkdir(parents=True)


def draw_demo_prior(out: Path, model: Path, percent: float, seed: int) -> None:
    """Write ``prior.json``, every parameter drawn within so many % of the truth.

    First of all, as it marks the folder as a demo's: one that was interrupted can be replaced.
    """
    from symbid_ros.estimation.prior import draw_prior
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    draw_prior(ParameterSet(load_model(model)), "percent", percent, seed).write(out / "prior.json")


def simulate_validation(bag: Path, moves: int, progress: Progress) -> None:
    """Write an ideal bag of other moves."""
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import Simulator

    simulator = Simulator("smooth", moves=moves, motion_seed=VALIDATION_SEED, ideal=True)
    task = progress.add_task("ideal validation bag", total=simulator.steps)
    record(simulator, bag, progress=lambda done, _: progress.update(task, completed=done))


def recording_facts(played: Mapping[str, Any], recorded: Mapping[str, Any]) -> dict[str, str]:
    """Return how the recording went, from what bridge and recorder say at their end."""
    kept = sum(recorded["recorded"].values())
    # The clock is published too, but not recorded: only topics of both count.
    published = sum(played["published"].get(topic, 0) for topic in recorded["recorded"])
    missing = sum(gap["missing"] for gap in recorded["gaps"].values())
    return {
        "Real-time factor": f"{played['real_time_factor']:.3f}, {played['late_steps']} late steps",
        "Messages": f"{kept} recorded of {published} published, {missing} missing by stamp",
    }
