"""``symbid study``."""

import os
from pathlib import Path
from time import monotonic
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Steps take up to a minute, so the remaining time is estimated over many of them, s.
SPEED_PERIOD = 300.0


def study(
    plan: Annotated[str, typer.Argument(help="A study that ships, or a YAML file of your own.")],
    out: Annotated[Path, typer.Option(help="Folder for results: new, or this study's own.")],
    workers: Annotated[
        int, typer.Option(min=0, max=256, help="Processes; 0: one for each core, at most 8.")
    ] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Begin anew where another study's results are.")
    ] = False,
) -> None:
    """Compare methods, priors, filters and logs, and write tables, figures and a page.

    Studies that ship: [b]thesis[/b] (the comparison of the thesis, its figures beside ours),
    [b]excitation[/b], [b]sensors[/b], [b]noise[/b], [b]length[/b] and [b]errors[/b]. Each is a
    commented file config/study_*.yaml; copy one and change a line for another.

    Stopped and started again it goes on where it was. Equal seeds give equal tables.
    """
    from symbid_ros.study.plan_file import load_plan
    from symbid_ros.study.publication import publish
    from symbid_ros.study.stages import study_stages
    from symbid_ros.study.study_folder import StudyFolder
    from symbid_ros.study.task_runner import Task, WorkerPool

    wanted, _ = load_plan(plan)
    folder = StudyFolder(out)
    folder.reserve(wanted, overwrite=overwrite)
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    todo = study_stages(wanted, folder)
    total = sum(task.cost for stage in todo for task in stage.tasks)
    with (
        Progress(
            *columns,
            console=console,
            disable=not console.is_terminal,
            speed_estimate_period=SPEED_PERIOD,
        ) as progress,
        WorkerPool(workers or min(8, os.cpu_count() or 1)) as pool,
    ):
        bar = progress.add_task("", total=total)

        def done(task: Task) -> None:
            progress.advance(bar, task.cost)

        for stage in todo:
            progress.update(bar, description=stage.title)
            left, begun = sum(not task.output.exists() for task in stage.tasks), monotonic()
            pool.run(stage.tasks, done)
            took = f", {left} of them in {monotonic() - begun:.0f} s" if left else ", all there"
            if stage.tasks:
                console.print(f"{stage.title}: {len(stage.tasks)} steps{took}", highlight=False)
        progress.update(bar, description="writing")
        page = publish(wanted, folder)
    typer.echo(f"wrote {page}")
