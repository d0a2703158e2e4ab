"""The thesis's tables with our figures in them, and one for studies that it did not make."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.content import REALISTIC_METRICS, TRUTH
from symbid_ros.report.formatting import ABSENT
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import thesis
from symbid_ros.study.checks import AccelerationCheck, EquationResidual
from symbid_ros.study.evidence import describe_filter, enumerate_words
from symbid_ros.study.plan import Plan, PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Scores
from symbid_ros.study.table import Cell, Column, Row, Table, reference_note
from symbid_ros.study.thesis import ACCELERATION_ERRORS, EQUATION_RESIDUALS, TITLES

COUNT = Column("Singular values")
COLUMNS = (*(Column(metric.title, metric.unit) for metric in TITLED), COUNT)
BEST = (
    "Means over {draws} priors; of each error the least over the filters, which may be another "
    "filter for each; the number of singular values is the mean over the filters. Bold: the "
    "least of one prior."
)

# What scales rows and columns, what is done where the data say nothing, and whether every link
# is one that a body can have (thesis, Table I and Eq. 23–32).
TECHNIQUES: Mapping[str, tuple[str, str, str, str]] = {
    REFERENCE: ("—", "—", "prior", "—"),
    "ols": ("no", "no", "prior, through the nullspace (Eq. 23)", "no"),
    "wls_r": ("1/σ of the OLS residual", "no", "prior, through the nullspace (Eq. 23)", "no"),
    "wls_c": ("no", "prior mean", "prior: truncation about its mean", "no"),
    "wls_rc": ("1/σ of the OLS residual", "prior mean", "prior: truncation about its mean", "no"),
    "map": ("full residual covariance", "prior deviation", "weighed against the prior", "no"),
    "map_lmi": ("full residual covariance", "prior deviation", "weighed against the prior", "yes"),
}


@dataclass(frozen=True)
class Draw:
    """One draw of the prior, and what the methods made of it.

    Attributes
    ----------
    data : str
        The data set.
    prior : PriorSpread
        How the prior was drawn.
    filter : float
        Hz, cutoff of the truncated methods' rows.
    names, units : tuple of str
        Of the p parameters.
    real : (p,) float64
        The truth.
    estimates : dict of str to (p,) float64
        By method, "ref" for the prior itself.

    Raises
    ------
    StudyError
        When the sizes do not agree.
    """

    data: str
    prior: PriorSpread
    filter: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    real: FloatArray
    estimates: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        sizes = {"units": len(self.units), "real": len(self.real)}
        sizes |= {method: len(values) for method, values in self.estimates.items()}
        for what, size in sizes.items():
            if size != len(self.names):
                raise StudyError(
                    f"draw on {self.data}: {what} has {size} entries for {len(self.names)} "
                    "parameters; give one for each",
                    "E709",
                )


def tables(plan: Plan, scores: Scores, draw: Draw | None = None) -> tuple[Table, ...]:
    """Return all tables that a study has the figures for.

    Parameters
    ----------
    plan : Plan
        The study; one with ``thesis`` gets the thesis's tables, any other one comparison.
    scores : Scores
        Its means.
    draw : Draw, optional
        For Table D.1.
    """
    made = [techniques(plan.methods)] if plan.thesis else [comparison(plan, scores)]
    if plan.thesis:
        for absolute in (False, True):
            if any((spread.kind == "absolute") == absolute for spread in plan.priors):
                made += [best_over_filters(plan, scores, data, absolute) for data in plan.data]
        made += [every_filter(plan, scores, data) for data in plan.data]
    made = [_with_metrics(sheet, plan.shown_metrics) for sheet in made]
    if draw is not None:
        made.append(parameters(draw))
    return tuple(made)


def techniques(methods: Iterable[str]) -> Table:
    """Return Table I: what each method scales, and what it does where the data say nothing."""
    return Table(
        name="table_1",
        title="Table I: solution techniques",
        caption="The thesis's five, and ours.",
        headings=(Column("Method"),),
        columns=(
            Column("Rows scaled by"),
            Column("Columns scaled by"),
            Column("Unobserved directions"),
            Column("Possible links guaranteed"),
        ),
        rows=tuple(
            Row((Cell(text=TITLES[method]),), tuple(Cell(text=word) for word in words))
            for method, words in TECHNIQUES.items()
            if method in _shown(methods)
        ),
    )


def best_over_filters(plan: Plan, scores: Scores, data: str, absolute: bool) -> Table:
    """Return Table II or, of absolute priors, Table 4.1: the least errors over the filters."""
    printed = thesis.table_4_1() if absolute else thesis.table_2()
    rows = []
    for spread in (str(one) for one in plan.priors if (one.kind == "absolute") == absolute):
        means = {method: scores.best(data, spread, method) for method in _shown(plan.methods)}
        rows += [
            Row(
                (Cell(text=spread), Cell(text=TITLES[method])),
                _figures(found, printed.best(thesis.DATA, spread, method), _least(means.values())),
            )
            for method, found in means.items()
            if found
        ]
    return Table(
        name=f"table_{'4_1' if absolute else '2'}_{_stem(data)}",
        title=f"Table {'4.1' if absolute else 'II'}: best over the filters, {data}",
        caption=BEST.format(draws=plan.iterations) + reference_note(rows),
        headings=(Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def every_filter(plan: Plan, scores: Scores, data: str) -> Table:
    """Return Table C.1: every prior, method and filter."""
    rows = []
    for spread in map(str, plan.priors):
        tried = {
            (method, cutoff): scores.at(data, spread, method, cutoff)
            for method in _shown(plan.methods)
            for cutoff in scores.filters(data, spread, method)
        }
        rows += [
            Row(
                (Cell(text=spread), Cell(text=TITLES[method]), _filter(method, cutoff)),
                _figures(
                    means,
                    thesis.table_c1().at(thesis.DATA, spread, method, cutoff),
                    _least(tried.values()),
                ),
            )
            for (method, cutoff), means in tried.items()
        ]
    return Table(
        name=f"table_c1_{_stem(data)}",
        title=f"Table C.1: every filter, {data}",
        caption=f"Means over {plan.iterations} priors. Bold: the least of one prior."
        + reference_note(rows),
        headings=(Column("Prior"), Column("Method"), Column("Filter", "Hz")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def comparison(plan: Plan, scores: Scores) -> Table:
    """Return the errors of every data set, prior and method."""
    rows = []
    for data in plan.data:
        for spread in map(str, plan.priors):
            means = {method: scores.best(data, spread, method) for method in _shown(plan.methods)}
            rows += [
                Row(
                    (Cell(text=data), Cell(text=spread), Cell(text=TITLES[method])),
                    _figures(found, {}, _least(means.values())),
                )
                for method, found in means.items()
                if found
            ]
    filters = ""
    if plan.truncated_methods:
        names = enumerate_words(TITLES[method] for method in _shown(plan.truncated_methods)[1:])
        filters = f"; rows of {names} {describe_filter(plan.filters[0])}"
    return Table(
        name="comparison",
        title="Comparison",
        caption=(
            BEST.format(draws=plan.iterations)
            if plan.truncated_methods and len(plan.filters) > 1
            else f"Means over {plan.iterations} priors{filters}. Bold: the least of one prior."
        ),
        headings=(Column("Data"), Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def _with_metrics(sheet: Table, shown: Sequence[str]) -> Table:
    """Return a sheet of errors with some of them alone; any other as it is."""
    if sheet.columns != COLUMNS:
        return sheet
    kept = [i for i, name in enumerate((*METRICS, RANK)) if name in shown or name == RANK]
    return replace(
        sheet,
        columns=tuple(COLUMNS[i] for i in kept),
        rows=tuple(replace(row, cells=tuple(row.cells[i] for i in kept)) for row in sheet.rows),
    )


def _shown(methods: Iterable[str]) -> list[str]:
    chosen = {REFERENCE, *methods}
    return [method for method in TITLES if method in chosen]


def _least(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    found = list(rows)
    return {
        name: min(values)
        for name in METRICS
        if (values := [means[name] for means in found if name in means])
    }


def _figures(
    means: Mapping[str, float], printed: Mapping[str, float], least: Mapping[str, float]
) -> tuple[Cell, ...]:
    def cells() -> Iterator[Cell]:
        for name in (*METRICS, RANK):
            value = means.get(name)
            best = value is not None and value == least.get(name)
            yield Cell(value, printed.get(name), best=best)

    return tuple(cells())


def _filter(method: str, cutoff: float | None) -> Cell:
    if cutoff is not None:
        return Cell(cutoff, text=f"{cutoff:g}" if cutoff else "none")
    return Cell(text=ABSENT if method == REFERENCE else "windows")


def _stem(data: str) -> str:
    return data.replace(" ", "_")


def parameters(draw: Draw) -> Table:
    """Return Table D.1: every parameter, what each method made of it, and how far off that is."""
    printed = thesis.table_d1()
    methods = [method for method in TITLES if method in draw.estimates]
    rows = []
    for index, (name, unit) in enumerate(zip(draw.names, draw.units, strict=True)):
        real = float(draw.real[index])
        # The thesis's robot had no friction and its columns came first, in the same order.
        known = index < len(printed.real) and np.isclose(real, printed.real[index])
        cells = [Cell(real)]
        for method in methods:
            own = float(draw.estimates[method][index])
            theirs = (
                float(printed.estimates[method][index])
                if known and method in printed.estimates
                else None
            )
            cells += [Cell(own, theirs, has_ratio=False), Cell(_off(own, real), _off(theirs, real))]
        rows.append(Row((Cell(text=name), Cell(text=unit)), tuple(cells)))
    columns = [Column("Real")]
    for method in methods:
        columns += [Column(TITLES[method]), Column(f"{TITLES[method]} error", "%")]
    return Table(
        name="table_d1",
        title=f"Table D.1: parameters, {draw.data}",
        caption=(
            f"One draw of a {draw.prior} prior, rows of the truncated methods filtered at "
            f"{draw.filter:g} Hz; errors relative to the real value." + reference_note(rows)
        ),
        headings=(Column("Parameter"), Column("Unit")),
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            "The thesis's figures are one draw of a ±25 % prior at 50 Hz, another one than ours: "
            "single ratios tell of the draws as much as of the methods.",
        )
        if reference_note(rows)
        else (),
    )


def _off(value: float | None, real: float) -> float | None:
    return None if value is None or real == 0 else 100 * abs(value - real) / abs(real)


LABELS = {**TITLES, TRUTH: "Truth"}


def equation_table(residuals: Sequence[EquationResidual]) -> Table:
    """Return Appendix B's check of the equation of motion."""
    return Table(
        name="appendix_b",
        title="Appendix B: does the equation of motion close?",
        caption=(
            "Root mean square of y − K φ at the true parameters on noise-free logs, norm per "
            "sample; with friction at instants at which no joint may stick. Second the order of "
            "magnitude that the thesis states."
        ),
        headings=(Column("Robot"), Column("Model"), Column("Contact forces")),
        columns=(Column("RMSE", "N, Nm"),),
        rows=tuple(
            Row(
                (Cell(text=one.robot), Cell(text=one.model), Cell(text=one.wrenches)),
                (Cell(one.rmse, EQUATION_RESIDUALS.get((one.robot, one.model, one.wrenches))),),
            )
            for one in residuals
        ),
        notes=(
            "The thesis reaches 1e-14 with friction in Simscape, whose contact forces are exact; "
            "in MuJoCo it takes recorded contact forces and no friction columns (order 1), then "
            "contact forces rebuilt by Eq. 4.1.",
        ),
    )


def acceleration_table(checks: Mapping[str, AccelerationCheck], cutoff: float) -> Table:
    """Return what a filter does to joint accelerations (Eq. 4.2)."""
    return Table(
        name="accelerations",
        title="Filtered joint accelerations",
        caption=(
            f"True joint accelerations, and the error e_a of those differentiated from positions "
            f"filtered at {cutoff:g} Hz (thesis, Eq. 4.2); root mean square of the norm."
        ),
        headings=(Column("Log"),),
        columns=(Column("Acceleration", "rad/s²"), Column("e_a", "rad/s²")),
        rows=tuple(
            Row(
                (Cell(text=name),),
                (Cell(one.rms), Cell(one.error, ACCELERATION_ERRORS.get(name))),
            )
            for name, one in checks.items()
        ),
    )


def realistic_table(means: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the errors of predictions as a robot could make them, by method."""
    judged = {method: found for method, found in means.items() if method != TRUTH}
    least = {
        metric.key: min(found[metric.key] for found in judged.values())
        for metric in REALISTIC_METRICS
    }
    return Table(
        name="realistic",
        title="Errors of realistic predictions",
        caption=(
            "Means over the draws: velocities filtered in real time, accelerations as desired, "
            "contact forces predicted by Eq. 4.1; “by wrenches”: torques from the measured contact "
            "forces instead. Bold: the least."
        ),
        headings=(Column("Method"),),
        columns=tuple(Column(metric.title, metric.unit) for metric in REALISTIC_METRICS),
        rows=tuple(
            Row(
                (Cell(text=LABELS[method]),),
                tuple(
                    Cell(
                        means[method][metric.key],
                        best=method != TRUTH and means[method][metric.key] == least[metric.key],
                    )
                    for metric in REALISTIC_METRICS
                ),
            )
            for method in LABELS
            if method in means
        ),
    )


def balance_table(prior: str, runs: Mapping[str, Sequence[BalanceResult]]) -> Table:
    """Return how the balance controller did with each method's models."""
    return Table(
        name=f"closed_loop_{prior.replace(' ', '').replace('%', 'percent').replace('±', '')}",
        title=f"Closed loop, priors {prior}",
        caption=(
            "CoM tracking and the feed-forward share of the torques over the runs that lasted; "
            "a run ends with a fall, at a joint’s end stop, or when its model allows no torques."
        ),
        headings=(Column("Model"),),
        columns=(
            Column("Stood"),
            Column("CoM tracking, median", "mm"),
            Column("worst", "mm"),
            Column("Feed-forward", "%"),
            Column("Ended by"),
        ),
        rows=tuple(
            _balanced(LABELS[method], runs[method])
            for method in (*LABELS,)
            if method in runs and (method == REFERENCE or runs[method])
        ),
    )


def _balanced(name: str, runs: Sequence[BalanceResult]) -> Row:
    lasting = [run for run in runs if not run.failure]
    tracking = [run.com_rmse_mm for run in lasting]
    share = [100 * run.feed_forward_share for run in lasting]
    causes = sorted({run.failure for run in runs if run.failure})
    return Row(
        (Cell(text=name),),
        (
            Cell(text=f"{len(lasting)} of {len(runs)}"),
            Cell(float(np.median(tracking)) if tracking else None),
            Cell(max(tracking) if tracking else None),
            Cell(float(np.median(share)) if share else None),
            Cell(text="; ".join(causes) or "—"),
        ),
    )
