"""The tasks of a study, in stages; each stage needs the results of those before it."""

from dataclasses import dataclass
from itertools import product

from symbid_ros.choices import GAUSSIAN
from symbid_ros.report.content import TRUTH
from symbid_ros.study.checks import (
    check_equation,
    check_realistic,
    run_closed_loop,
    run_true_closed_loop,
)
from symbid_ros.study.draws import solve_draw
from symbid_ros.study.logs import fold_rows, record_log, record_tare
from symbid_ros.study.plan import Plan, SimulatedLog
from symbid_ros.study.study_folder import StudyFolder
from symbid_ros.study.task_runner import Task


@dataclass(frozen=True)
class Stage:
    """Tasks that are independent of each other.

    Attributes
    ----------
    title : str
        Label of the progress bar.
    tasks : tuple of Task
    """

    title: str
    tasks: tuple[Task, ...]


def study_stages(plan: Plan, folder: StudyFolder) -> tuple[Stage, ...]:
    """Return all tasks of a plan; tasks with the same output are merged."""
    return tuple(
        Stage(title, tuple({task.output: task for task in tasks}.values()))
        for title, tasks in (
            ("simulating", _log_tasks(plan, folder)),
            ("folding rows", _row_tasks(plan, folder)),
            ("identifying", _draw_tasks(plan, folder)),
            ("checking", _check_tasks(plan, folder)),
        )
    )


def _log_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    logs: list[SimulatedLog] = [*plan.data.values()]
    logs += [plan.validation_log(name) for name in plan.data]
    if plan.figures is not None:
        logs.append(plan.noisy_validation_log(plan.figures.data))
    if plan.accelerations is not None:
        logs += plan.accelerations.logs.values()
    if plan.equation is not None:
        logs += [plan.equation.model_copy(update={"friction": on}) for on in (False, True)]
    tasks = [Task(folder.log(log), record_log, (log, folder), 2.0 * log.moves) for log in logs]
    # The longest first, so that all workers finish at about the same time.
    tasks.sort(key=lambda task: -task.cost)
    tares = [log for log in plan.data.values() if log.cure]
    return tasks + [Task(folder.tare(log), record_tare, (log, folder), 5.0) for log in tares]


def _row_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    tasks = []
    for name, data in plan.data.items():
        cutoffs: list[float | None] = list(plan.filters) if plan.truncated_methods else []
        if set(plan.methods) & set(GAUSSIAN) and not data.cure:
            cutoffs.append(None)
        pairs: list[tuple[SimulatedLog, float | None]] = [(data, cutoff) for cutoff in cutoffs]
        if plan.z.using == "validation":
            ideal = plan.validation_log(name)
            pairs += [(ideal, cutoff) for cutoff in cutoffs if cutoff is not None]
        for log, cutoff in pairs:
            arguments = (log, folder, data.sensors, cutoff, plan.channels)
            cost = 0.3 * log.moves if cutoff in (0, None) else 0.12 * log.moves
            tasks.append(Task(folder.rows(log, data.sensors, cutoff), fold_rows, arguments, cost))
    return tasks


def _draw_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    tasks = []
    for name, data in plan.data.items():
        cost = 40.0 if data.cure else 1.5
        for spread, iteration in product(plan.priors, range(plan.iterations)):
            arguments = (plan, folder, name, spread, iteration)
            tasks.append(Task(folder.draw(name, spread, iteration), solve_draw, arguments, cost))
    return tasks


def _check_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    tasks = []
    if (loop := plan.closed_loop) is not None:
        cost = 1.5 * loop.moves
        tasks.append(Task(folder.check(TRUTH), run_true_closed_loop, (loop, folder), cost))
        tasks += [
            Task(folder.loop(*run), run_closed_loop, (loop, folder, *run), cost)
            for run in product(loop.priors, range(loop.iterations), plan.compared)
        ]
    if plan.equation is not None:
        output = folder.check("equation")
        tasks.append(Task(output, check_equation, (plan.equation, folder), 5.0))
    if plan.figures is not None:
        output = folder.check("realistic")
        tasks.append(Task(output, check_realistic, (plan, plan.figures, folder), 20.0))
    return tasks
