"""The tasks of a study, in stages that depend on the stages before them."""

from dataclasses import dataclass

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
            ("checking", [*_closed_loop_tasks(plan, folder), *_check_tasks(plan, folder)]),
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
    return sorted(tasks, key=lambda task: -task.cost) + [
        Task(folder.tare(log), record_tare, (log, folder), 5.0)
        for log in plan.data.values()
        if log.cure
    ]


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
    return [
        Task(
            folder.draw(name, spread, iteration),
            solve_draw,
            (plan, folder, name, spread, iteration),
            40.0 if data.cure else 1.5,
        )
        for name, data in plan.data.items()
        for spread in plan.priors
        for iteration in range(plan.iterations)
    ]


def _closed_loop_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    loop = plan.closed_loop
    if loop is None:
        return []
    cost = 1.5 * loop.moves
    tasks = [
        Task(
            folder.loop(spread, iteration, method),
            run_closed_loop,
            (loop, folder, spread, iteration, method),
            cost,
        )
        for spread in loop.priors
        for iteration in range(loop.iterations)
        for method in plan.compared
    ]
    return [Task(folder.check(TRUTH), run_true_closed_loop, (loop, folder), cost), *tasks]


def _check_tasks(plan: Plan, folder: StudyFolder) -> list[Task]:
    tasks = []
    if plan.equation is not None:
        output = folder.check("equation")
        tasks.append(Task(output, check_equation, (plan.equation, folder), 5.0))
    if plan.figures is not None:
        output = folder.check("realistic")
        tasks.append(Task(output, check_realistic, (plan, plan.figures, folder), 20.0))
    return tasks
