"""``symbid study``."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from symbid_ros.cli.cluster import Dask, print_dashboard
from symbid_ros.cli.verbosity import progress_columns, shows_progress

# Tasks take up to a minute, so the remaining time is estimated from many of them, s.
SPEED_PERIOD = 300.0


def study(
    plan: Annotated[str, typer.Argument(help="Name of a shipped study, or a YAML file.")],
    out: Annotated[Path, typer.Option(help="Folder for results: new, or this study's own.")],
    workers: Annotated[
        int, typer.Option(min=0, max=256, help="Number of processes; 0: one per core, at most 8.")
    ] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results of another study.")
    ] = False,
    dask: Dask = None,
) -> None:
    """Compare methods, priors, filters and logs, and write tables, figures and a page.

    Shipped studies: [b]thesis[/b] (the thesis's comparison, with its values next to ours),
    [b]excitation[/b], [b]sensors[/b], [b]noise[/b], [b]length[/b] and [b]errors[/b]. Each is a
    commented file config/study_*.yaml; to run another study, edit a copy.

    An interrupted study resumes if it is started again. Equal seeds give equal tables.
    """
    from symbid_ros.study.page import publish
    from symbid_ros.study.plan import load_plan
    from symbid_ros.study.stages import study_stages
    from symbid_ros.study.study_folder import StudyFolder
    from symbid_ros.study.task_runner import Task, run_tasks

    content, _ = load_plan(plan)
    folder = StudyFolder(out.absolute() if dask else out)
    console = Console(stderr=True)
    stages = study_stages(content, folder)
    total = sum(task.cost for stage in stages for task in stage.tasks)
    with (
        _worker_pool(
            workers, dask, folder.work, lambda: folder.reserve(content, overwrite=overwrite)
        ) as pool,
        Progress(
            *progress_columns(),
            console=console,
            disable=not shows_progress(console),
            speed_estimate_period=SPEED_PERIOD,
        ) as progress,
    ):
        bar = progress.add_task("", total=total)

        def on_done(task: Task) -> None:
            progress.advance(bar, task.cost)

        for stage in stages:
            progress.update(bar, description=stage.title)
            missing = sum(not task.output.exists() for task in stage.tasks)
            start = monotonic()
            run_tasks(pool, stage.tasks, on_done)
            done = f"{missing} run in {monotonic() - start:.0f} s" if missing else "all complete"
            if stage.tasks:
                console.print(f"{stage.title}: {len(stage.tasks)} tasks, {done}", highlight=False)
        progress.update(bar, description="writing results")
        page = publish(content, folder)
        folder.complete()
    typer.echo(f"wrote {page}")


@contextmanager
def _worker_pool(
    workers: int, dask: str | None, folder: Path, reserve: Callable[[], None]
) -> Iterator[Executor]:
    """Start processes that run tasks, or use the workers of a cluster, which must see a folder.

    ``reserve`` is called before, but not until the cluster answers.
    """
    from symbid_ros.study.task_runner import worker_pool

    if dask is None:
        reserve()
        with worker_pool(workers or min(8, os.cpu_count() or 1)) as pool:
            yield pool
        return
    from symbid_ros.cluster.connection import connected

    with connected(dask) as cluster:
        print_dashboard(cluster.dashboard)
        reserve()
        yield cluster.executor_of(folder)
