"""What a study has to work out, in order: each stage needs those before it."""

from dataclasses import dataclass

from symbid_ros.choices import GAUSSIAN
from symbid_ros.report.content import TRUTH
from symbid_ros.study.checks import believers, check_equation, check_realistic, run_loop, run_truth
from symbid_ros.study.draws import solve_draw
from symbid_ros.study.logs import fold_rows, record_log, record_tare
from symbid_ros.study.plan import Log, Plan
from symbid_ros.study.task_runner import Task
from symbid_ros.study.workspace import Workspace


@dataclass(frozen=True)
class Stage:
    """Tasks that need nothing of one another.

    Attributes
    ----------
    title : str
        What is being done, for a progress bar.
    tasks : tuple of Task
    """

    title: str
    tasks: tuple[Task, ...]


def stages(plan: Plan, space: Workspace) -> tuple[Stage, ...]:
    """Return all that the plan asks for."""
    return tuple(
        Stage(title, tuple({task.output: task for task in tasks}.values()))
        for title, tasks in (
            ("simulating", _logs(plan, space)),
            ("folding rows", _rows(plan, space)),
            ("identifying", _draws(plan, space)),
            ("checking", [*_loops(plan, space), *_checks(plan, space)]),
        )
    )


def _logs(plan: Plan, space: Workspace) -> list[Task]:
    wanted: list[Log] = [*plan.data.values()]
    wanted += [plan.validation_of(name) for name in plan.data]
    if plan.figures is not None:
        wanted.append(plan.realistic_of(plan.figures.data))
    if plan.accelerations is not None:
        wanted += plan.accelerations.logs.values()
    if plan.equation is not None:
        wanted += [plan.equation.model_copy(update={"friction": on}) for on in (False, True)]
    tasks = [Task(space.log(log), record_log, (log, space), 2.0 * log.moves) for log in wanted]
    # The longest first, so that all workers end together.
    return sorted(tasks, key=lambda task: -task.cost) + [
        Task(space.tare(log), record_tare, (log, space), 5.0)
        for log in plan.data.values()
        if log.cure
    ]


def _rows(plan: Plan, space: Workspace) -> list[Task]:
    tasks = []
    for name, data in plan.data.items():
        cutoffs: list[float | None] = list(plan.filters) if plan.truncated else []
        if set(plan.methods) & set(GAUSSIAN) and not data.cure:
            cutoffs.append(None)
        both: list[tuple[Log, float | None]] = [(data, cutoff) for cutoff in cutoffs]
        if plan.z.using == "validation":
            ideal = plan.validation_of(name)
            both += [(ideal, cutoff) for cutoff in cutoffs if cutoff is not None]
        for log, cutoff in both:
            arguments = (log, space, data.sensors, cutoff, plan.channels)
            cost = 0.3 * log.moves if cutoff in (0, None) else 0.12 * log.moves
            tasks.append(Task(space.rows(log, data.sensors, cutoff), fold_rows, arguments, cost))
    return tasks


def _draws(plan: Plan, space: Workspace) -> list[Task]:
    return [
        Task(
            space.draw(name, spread, iteration),
            solve_draw,
            (plan, space, name, spread, iteration),
            40.0 if data.cure else 1.5,
        )
        for name, data in plan.data.items()
        for spread in plan.priors
        for iteration in range(plan.iterations)
    ]


def _loops(plan: Plan, space: Workspace) -> list[Task]:
    loop = plan.closed_loop
    if loop is None:
        return []
    cost = 1.5 * loop.moves
    tasks = [
        Task(
            space.loop(spread, iteration, method),
            run_loop,
            (loop, space, spread, iteration, method),
            cost,
        )
        for spread in loop.priors
        for iteration in range(loop.iterations)
        for method in believers(plan)
    ]
    return [Task(space.check(TRUTH), run_truth, (loop, space), cost), *tasks]


def _checks(plan: Plan, space: Workspace) -> list[Task]:
    tasks = []
    if plan.equation is not None:
        place = space.check("equation")
        tasks.append(Task(place, check_equation, (plan.equation, space), 5.0))
    if plan.figures is not None:
        place = space.check("realistic")
        tasks.append(Task(place, check_realistic, (plan, plan.figures, space), 20.0))
    return tasks
