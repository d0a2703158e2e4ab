"""The parts of a study's page, in the order in which they are read."""

from collections.abc import Iterator
from dataclasses import dataclass

from symbid_ros.model.tree import RobotModel
from symbid_ros.report.content import TRUTH, LinkErrors
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import thesis
from symbid_ros.study.checks import (
    check_accelerations,
    load_closed_loop_runs,
    load_equation_residuals,
    load_realistic,
)
from symbid_ros.study.conclusions import (
    Links,
    closed_loop_conclusions,
    conclusions,
    data_sentences,
    realistic_conclusion,
)
from symbid_ros.study.draws import StudyResults
from symbid_ros.study.evidence import Conclusion, Evidence
from symbid_ros.study.figures import (
    AccelerationLog,
    acceleration_drawing,
    closed_loop_drawing,
    comparison_drawing,
    grid_drawing,
    link_drawing,
)
from symbid_ros.study.plan import AccelerationPlan, ClosedLoopPlan, FigurePlan
from symbid_ros.study.plotting import LABELS, Drawing
from symbid_ros.study.prediction_figures import Setting, ideal_drawings, realistic_drawings
from symbid_ros.study.table import Table
from symbid_ros.study.tables import (
    Draw,
    acceleration_table,
    balance_table,
    equation_table,
    realistic_table,
    tables,
)

RUN_LABELS = {**LABELS, TRUTH: TRUTH}

# Tables longer than this open only when asked for.
LONG = 30


@dataclass(frozen=True)
class Section:
    """A part of the page; what it has none of is left out.

    Attributes
    ----------
    anchor, title, caption : str
        Fragment of the address, heading, and the sentence under it.
    conclusions : tuple of Conclusion
    sentences : tuple of str
        What the numbers say beside these.
    tables : tuple of Table
    drawings : tuple of Drawing
    folded : bool
        Whether its tables open only when asked for: long ones.
    """

    anchor: str
    title: str
    caption: str = ""
    conclusions: tuple[Conclusion, ...] = ()
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    folded: bool = False


def sections(results: StudyResults) -> tuple[Section, ...]:
    """Return everything that the plan asks for, worked out already.

    Raises
    ------
    StudyError
        When something is missing.
    """
    plan = results.plan
    parts = [*_concluding(results)] if plan.thesis else [*_comparing(results)]
    made = tables(plan, results.scores, _draw(results))
    parts.append(_tabled("tables", "Tables", [one for one in made if len(one.rows) <= LONG]))
    if plan.figures is not None:
        parts += _predicted(results, plan.figures)
    if plan.accelerations is not None:
        parts.append(_accelerated(results, plan.accelerations))
    if plan.equation is not None:
        residuals = load_equation_residuals(results.folder)
        parts.append(_tabled("equation", "Equation of motion", [equation_table(residuals)]))
    if plan.closed_loop is not None:
        parts.append(_balanced(results, plan.closed_loop))
    if plan.thesis:
        parts.append(_gridded(results))
    long = [one for one in made if len(one.rows) > LONG]
    if long:
        parts.append(_tabled("all", "Every number", long, folded=True))
    return tuple(parts)


def _tabled(anchor: str, title: str, made: list[Table], *, folded: bool = False) -> Section:
    return Section(anchor, title, tables=tuple(made), folded=folded)


def _concluding(results: StudyResults) -> Iterator[Section]:
    """Examine the thesis's conclusions on each data set."""
    plan = results.plan
    for data in plan.data:
        evidence = Evidence(results.scores, data, tuple(plan.priors), results.row_errors(data))
        links = None
        if plan.figures is not None and plan.figures.data == data:
            links = _links(results, plan.figures)
        found: list[Conclusion | None] = [*conclusions(evidence, links)]
        if plan.figures is not None and plan.figures.data == data:
            found.append(_realistic_conclusion(results, plan.figures))
        yield Section(
            f"conclusions-{data.replace(' ', '-')}",
            f"Conclusions on {data} data",
            "What the thesis concludes, and whether the numbers below bear it out. Every sentence "
            "is computed from them.",
            conclusions=tuple(one for one in found if one is not None),
        )


def _links(results: StudyResults, figures: FigurePlan) -> Links:
    errors = results.link_errors(figures.data, figures.prior, figures.links)
    parameters = results.true_parameters(figures.data)
    return Links(LinkErrors(parameters.link_names, errors), _depth(parameters.model))


def _depth(model: RobotModel) -> tuple[int, ...]:
    """Return how many joints lie between the base and each link that has parameters."""
    depth = {0: 0}
    for child, joint in enumerate(model.joints, 1):
        depth[child] = depth[joint.parent] + 1
    return tuple(depth[i] for i, link in enumerate(model.links) if not link.virtual)


def _realistic_conclusion(results: StudyResults, figures: FigurePlan) -> Conclusion | None:
    means = load_realistic(results.folder)
    ideal = {TRUTH: 0.0}
    for method in means:
        at = results.scores.at(
            figures.data, str(figures.prior), method, results.cutoff(method, figures.torque)
        )
        if at:
            ideal[method] = at["torque_rmse"]
    return realistic_conclusion(ideal, {name: one["torque_rmse"] for name, one in means.items()})


def _comparing(results: StudyResults) -> Iterator[Section]:
    """Compare data sets where the thesis has no say."""
    plan = results.plan
    methods = plan.compared
    cutoff = plan.filters[0] if len(plan.filters) == 1 else None
    for index, spread in enumerate(map(str, plan.priors)):
        yield Section(
            f"comparison-{index}",
            f"Priors {spread}",
            sentences=data_sentences(results.scores, [*plan.data], spread, plan.methods),
            drawings=(
                comparison_drawing(
                    results.scores, [*plan.data], spread, methods, cutoff, shown=plan.shown_metrics
                ),
            ),
        )


def _gridded(results: StudyResults) -> Section:
    plan = results.plan
    methods = plan.compared
    printed = thesis.table_c1()
    return Section(
        "filters",
        "Filters",
        "Each error against the cutoff of the filter; hollow: the thesis’s (Table C.1).",
        drawings=tuple(
            grid_drawing(
                results.scores, data, str(spread), methods, printed, shown=plan.shown_metrics
            )
            for data in plan.data
            for spread in plan.priors
        ),
    )


def _draw(results: StudyResults) -> Draw | None:
    figures = results.plan.figures
    if figures is None:
        return None
    parameters = results.true_parameters(figures.data)
    return Draw(
        data=figures.data,
        prior=figures.prior,
        filter=figures.parameters,
        names=parameters.names,
        units=parameters.units,
        real=parameters.values,
        estimates={
            method: results.estimate(figures.data, figures.prior, method, figures.parameters)
            for method in results.plan.compared
        },
    )


def _predicted(results: StudyResults, figures: FigurePlan) -> Iterator[Section]:
    """Show what single estimates predict, and how accurate links are."""
    links = _links(results, figures).errors
    percent = {LABELS[method]: found for method, found in links.percent.items()}
    setting = Setting(figures.data, str(figures.prior), figures.links)
    yield Section(
        "predictions",
        "Predictions",
        "Of the first draw’s estimates, along the ideal validation motion. The cutoffs are the "
        "plan’s, which need not be the best ones (Table C.1).",
        drawings=(
            *ideal_drawings(results, figures),
            link_drawing(LinkErrors(links.links, percent), setting, results.plan.iterations),
        ),
    )
    yield Section(
        "realistic",
        "Realistic predictions",
        "The same estimates and the same motion, from what the robot itself could measure.",
        tables=(realistic_table(load_realistic(results.folder)),),
        drawings=realistic_drawings(results, figures),
    )


def _accelerated(results: StudyResults, accelerations: AccelerationPlan) -> Section:
    checks = {
        name: check_accelerations(accelerations, name, results.folder)
        for name in accelerations.logs
    }
    printed = thesis.ACCELERATION_ERRORS
    logs = [
        AccelerationLog(name, one.time, one.acceleration, one.error, printed.get(name))
        for name, one in checks.items()
    ]
    names = next(iter(checks.values())).joint_names
    return Section(
        "accelerations",
        "Vibration and the filter",
        tables=(acceleration_table(checks, accelerations.cutoff),),
        drawings=(acceleration_drawing(logs, names, accelerations.cutoff),),
    )


def _balanced(results: StudyResults, loop: ClosedLoopPlan) -> Section:
    by_prior = {
        str(spread): load_closed_loop_runs(results.plan, results.folder, spread)
        for spread in loop.priors
    }
    together: dict[str, list[BalanceResult]] = {}
    for runs in by_prior.values():
        for method, found in runs.items():
            together.setdefault(method, []).extend(found)
    together[TRUTH] = together[TRUTH][:1]
    about = f"{loop.moves} moves; priors {', '.join(by_prior)}, estimates from {loop.data} data."
    return Section(
        "closed-loop",
        "Closed loop",
        "The balance controller moves the true robot, believing the prior, an estimate or the "
        f"truth: {about}",
        conclusions=closed_loop_conclusions(together),
        tables=tuple(balance_table(prior, runs) for prior, runs in by_prior.items()),
        drawings=(
            closed_loop_drawing(
                {RUN_LABELS[method]: runs for method, runs in together.items()}, about
            ),
        ),
    )
