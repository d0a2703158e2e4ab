"""``symbid demo --learn``: a robot with a wrong model falls, and one that learns its own stands."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.text import Text

from symbid_ros.atomic_write import write_text
from symbid_ros.cli.fitted_tables import print_table

if TYPE_CHECKING:
    from symbid_ros.learning.lockstep import LearningRun

# A prior of ±25 % with which the robot falls in its first large move.
SEED = 2
# What the robots carry with --payload, and between which shares of the motion. The identifier
# forgets with this time constant, s, as otherwise it would mix data with and without a payload.
CARRIED_LINK, CARRIED_MASS, PLACE = "L_thigh", 5.0, (0.2, 0.0, 0.05)
ATTACHED, REMOVED = 0.4, 0.7
MEMORY = 10.0


def write_wrong_model(out: Path, model: Path) -> Path:
    """Write ``wrong.xml``, the model with the values of the prior in the folder."""
    from symbid_ros.estimation.prior_file import load_prior
    from symbid_ros.model.export_mjcf import mjcf_text
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    parameters = ParameterSet(load_model(model))
    prior = load_prior(out / "prior.json", parameters)
    wrong = out / "wrong.xml"
    write_text(wrong, mjcf_text(parameters.apply(prior.mean), model))
    return wrong


def demonstrate_learning(
    out: Path,
    model: Path,
    moves: int,
    percent: float,
    seed: int,
    console: Console,
    *,
    with_payload: bool = False,
) -> None:
    """Let three robots move side by side, and report, with the prior in the folder."""
    from symbid_ros.learning.figures import ALONE, LEARNING, TRUE
    from symbid_ros.learning.lockstep import SMOOTH, LearningRun, LearningTask
    from symbid_ros.learning.page import event_text, summary_rows, verdict, write_learning_report
    from symbid_ros.model.load import load_model
    from symbid_ros.simulation.body_inertia import Payload

    robot = load_model(model)
    wrong = write_wrong_model(out, model)
    task = LearningTask(wrong, moves=moves, noise_seed=seed, scenario=SMOOTH)
    if with_payload:
        duration = LearningRun(task, learns=False).duration
        task = replace(
            task,
            payload=Payload(CARRIED_LINK, CARRIED_MASS, PLACE),
            attached=round(ATTACHED * duration, 1),
            removed=round(REMOVED * duration, 1),
            memory=MEMORY,
        )
    known = replace(task, model=model)
    runs = {
        ALONE: LearningRun(task, learns=False),
        LEARNING: LearningRun(task, learns=True, bag=out / "bag"),
        TRUE: LearningRun(known, learns=False),
    }
    console.print(
        f"Three robots move for {runs[TRUE].duration:.0f} s of simulated time. The models of two "
        f"are wrong by up to {percent:g} % in each number; one of these learns its own."
    )
    carried = {}
    if with_payload:
        text = (
            f"{CARRIED_MASS:g} kg on {CARRIED_LINK} from {task.attached:g} s to {task.removed:g} s"
        )
        console.print(f"They carry {text}, which no model contains.")
        carried["Payload"] = text
    with _bars(console) as progress:
        active = {
            label: _follow(progress, progress.add_task(label, total=run.duration, now=""), run)
            for label, run in runs.items()
        }
        while active:
            for label, seconds in list(active.items()):
                if next(seconds, None) is None:
                    del active[label]
    records = {label: run.record() for label, run in runs.items()}
    learning = records[LEARNING]
    console.print()
    for event in learning.events:
        line = f"{event.time:5.1f} s  {event_text(learning, event.time, event.kind, event.text)}"
        console.print(Text(line))
    rows = [(name, [Text(cell) for cell in cells]) for name, cells in summary_rows(records)]
    print_table(console, "", [list(records)], rows)
    facts = {
        "Prior": f"±{percent:g} %, seed {seed}; {wrong.name} has its values",
        "Moves": f"{moves} moves of the centre of mass and turns of the trunk ({task.scenario})",
        **carried,
        "Bag": "bag/, all topics of the robot that learns",
        "Time": "simulated; robot, controller and identifier run in lockstep in one process",
    }
    write_learning_report(out, robot, records, facts)
    console.print(verdict(records))


def _bars(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description:<10}"),
        BarColumn(bar_width=None),
        TextColumn("{task.fields[now]:<24}"),
        console=console,
    )


def _follow(progress: Progress, task: TaskID, run: "LearningRun") -> Iterator[float]:
    """Simulate, and show after each second how far the robot moves, or that it fell."""
    for time in run.seconds():
        progress.update(task, completed=time, now=f"{time:.0f} s, moves {100 * run.reach:.0f} %")
        yield time
    failures = [event for event in run.events if event.kind == "fell"]
    now = f"fell at {failures[0].time:.1f} s" if failures else "stands"
    progress.update(task, now=now)
