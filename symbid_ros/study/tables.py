"""The thesis's tables with values of a study, and a comparison table for other studies."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.content import REALISTIC_METRICS, TRUTH
from symbid_ros.report.formatting import ABSENT
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import thesis
from symbid_ros.study.checks import AccelerationCheck, EquationResidual
from symbid_ros.study.evidence import describe_filter
from symbid_ros.study.plan import Plan
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Scores
from symbid_ros.study.table import (
    Cell,
    Column,
    Table,
    TableRow,
    file_stem,
    reference_note,
    text_cells,
)
from symbid_ros.study.thesis import ACCELERATION_ERRORS, EQUATION_RESIDUALS, TITLES

COUNT = Column("Singular values")
COLUMNS = (*(Column(metric.title, metric.unit) for metric in TITLED), COUNT)
BOLD = f"Bold: the smallest value for each prior. {TITLES[REFERENCE]}: the prior."
BEST = (
    "Means over {draws} priors. Each error is the smallest over the filters, each with its own "
    f"filter; the number of singular values is the mean over the filters. {BOLD}"
)

# Scale of rows and of columns, treatment of unobserved directions, and whether every link is
# physically possible (thesis, Table I and Eq. 23–32).
TECHNIQUES: Mapping[str, tuple[str, str, str, str]] = {
    REFERENCE: ("—", "—", "prior", "—"),
    "ols": ("no", "no", "prior, through the nullspace (Eq. 23)", "no"),
    "wls_r": ("1/σ of the OLS residual", "no", "prior, through the nullspace (Eq. 23)", "no"),
    "wls_c": ("no", "prior mean", "prior: truncation about its mean", "no"),
    "wls_rc": ("1/σ of the OLS residual", "prior mean", "prior: truncation about its mean", "no"),
    "map": ("full residual covariance", "prior deviation", "weighed against the prior", "no"),
    "map_lmi": ("full residual covariance", "prior deviation", "weighed against the prior", "yes"),
}


def score_tables(plan: Plan, scores: Scores) -> list[Table]:
    """Return the tables of errors: those of the thesis for its study, else one comparison."""
    if plan.thesis:
        tables = []
        for absolute in (False, True):
            if any((spread.kind == "absolute") == absolute for spread in plan.priors):
                tables += [best_table(plan, scores, data, absolute) for data in plan.data]
        tables += [filter_table(plan, scores, data) for data in plan.data]
    else:
        tables = [comparison_table(plan, scores)]
    kept = [i for i, key in enumerate((*METRICS, RANK)) if key in (*plan.shown_metrics, RANK)]
    return [
        replace(
            table,
            columns=tuple(COLUMNS[i] for i in kept),
            rows=tuple(replace(row, cells=tuple(row.cells[i] for i in kept)) for row in table.rows),
        )
        for table in tables
    ]


def technique_table(methods: Iterable[str]) -> Table:
    """Return Table I: what each method scales, and how it treats unobserved directions."""
    return Table(
        name="table_1",
        title="Table I: solution techniques",
        caption="The five techniques of the thesis, and ours.",
        headings=(Column("Method"),),
        columns=(
            Column("Rows scaled by"),
            Column("Columns scaled by"),
            Column("Unobserved directions"),
            Column("Possible links guaranteed"),
        ),
        rows=tuple(
            TableRow(text_cells(TITLES[method]), text_cells(*TECHNIQUES[method]))
            for method in _ordered(methods)
        ),
    )


def best_table(plan: Plan, scores: Scores, data: str, absolute: bool) -> Table:
    """Return Table II or, for absolute priors, Table 4.1: the smallest errors over the filters."""
    printed = thesis.table_4_1() if absolute else thesis.table_2()
    rows = []
    for spread in (str(one) for one in plan.priors if (one.kind == "absolute") == absolute):
        means = {method: scores.best(data, spread, method) for method in _ordered(plan.methods)}
        rows += [
            TableRow(
                text_cells(spread, TITLES[method]),
                _score_cells(found, printed.best(thesis.DATA, spread, method), means.values()),
            )
            for method, found in means.items()
            if found
        ]
    return Table(
        name=f"table_{'4_1' if absolute else '2'}_{file_stem(data)}",
        title=f"Table {'4.1' if absolute else 'II'}: best over the filters, {data}",
        caption=BEST.format(draws=plan.iterations) + reference_note(rows),
        headings=(Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def filter_table(plan: Plan, scores: Scores, data: str) -> Table:
    """Return Table C.1: every prior, method and filter."""
    rows = []
    for spread in map(str, plan.priors):
        tried = {
            (method, cutoff): scores.at(data, spread, method, cutoff)
            for method in _ordered(plan.methods)
            for cutoff in scores.filters(data, spread, method)
        }
        for (method, cutoff), means in tried.items():
            printed = thesis.table_c1().at(thesis.DATA, spread, method, cutoff)
            labels = (*text_cells(spread, TITLES[method]), _filter_cell(method, cutoff))
            rows.append(TableRow(labels, _score_cells(means, printed, tried.values())))
    return Table(
        name=f"table_c1_{file_stem(data)}",
        title=f"Table C.1: every filter, {data}",
        caption=f"Means over {plan.iterations} priors. {BOLD}{reference_note(rows)}",
        headings=(Column("Prior"), Column("Method"), Column("Filter", "Hz")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def comparison_table(plan: Plan, scores: Scores) -> Table:
    """Return the errors of every data set, prior and method."""
    rows = []
    for data in plan.data:
        for spread in map(str, plan.priors):
            means = {method: scores.best(data, spread, method) for method in _ordered(plan.methods)}
            rows += [
                TableRow(
                    text_cells(data, spread, TITLES[method]),
                    _score_cells(found, {}, means.values()),
                )
                for method, found in means.items()
                if found
            ]
    filters = ""
    if plan.truncated_methods:
        names = enumerate_words(TITLES[method] for method in _ordered(plan.truncated_methods)[1:])
        filters = f"; rows of {names} {describe_filter(plan.filters[0])}"
    return Table(
        name="comparison",
        title="Comparison",
        caption=(
            BEST.format(draws=plan.iterations)
            if plan.truncated_methods and len(plan.filters) > 1
            else f"Means over {plan.iterations} priors{filters}. {BOLD}"
        ),
        headings=(Column("Data"), Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def _ordered(methods: Iterable[str]) -> list[str]:
    """Return the prior and the methods in the order of tables."""
    chosen = {REFERENCE, *methods}
    return [method for method in TITLES if method in chosen]


def _score_cells(
    means: Mapping[str, float],
    printed: Mapping[str, float],
    group: Collection[Mapping[str, float]],
) -> tuple[Cell, ...]:
    """Return the cells of :data:`COLUMNS`; the smallest error within the group is marked."""

    def is_best(name: str) -> bool:
        return name != RANK and means[name] == min(one[name] for one in group if name in one)

    return tuple(
        Cell(means.get(name), printed.get(name), best=name in means and is_best(name))
        for name in (*METRICS, RANK)
    )


def _filter_cell(method: str, cutoff: float | None) -> Cell:
    if cutoff is not None:
        return Cell(cutoff, text=f"{cutoff:g}" if cutoff else "none")
    return Cell(text=ABSENT if method == REFERENCE else "windows")


def parameter_table(
    true: ParameterSet, estimates: Mapping[str, FloatArray], data: str, source: str
) -> Table:
    """Return Table D.1: true value, estimates and relative errors of every parameter.

    Parameters
    ----------
    true : ParameterSet
        The p parameters with their true values.
    estimates : mapping of str to (p,) float64
        By method, "ref" for the prior itself.
    data, source : str
        Name of the data set, and the start of the caption: draw and filter.
    """
    printed = thesis.table_d1()
    methods = [method for method in TITLES if method in estimates]
    rows = []
    for index, (name, unit) in enumerate(zip(true.names, true.units, strict=True)):
        real = float(true.values[index])
        # The thesis's robot has no friction; its parameters are the first columns, in equal order.
        known = index < len(printed.real) and np.isclose(real, printed.real[index])
        cells = [Cell(real)]
        for method in methods:
            own, theirs = float(estimates[method][index]), None
            if known and method in printed.estimates:
                theirs = float(printed.estimates[method][index])
            errors = Cell(_relative_error(own, real), _relative_error(theirs, real))
            cells += [Cell(own, theirs, has_ratio=False), errors]
        rows.append(TableRow(text_cells(name, unit), tuple(cells)))
    columns = [Column("Real")]
    for method in methods:
        columns += [Column(TITLES[method]), Column(f"{TITLES[method]} error", "%")]
    note = reference_note(rows)
    return Table(
        name="table_d1",
        title=f"Table D.1: parameters, {data}",
        caption=f"{source}; errors relative to the real value.{note}",
        headings=(Column("Parameter"), Column("Unit")),
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            "The thesis's values are from another draw, of a ±25 % prior at 50 Hz: single ratios "
            "depend on the draws as much as on the methods.",
        )
        if note
        else (),
    )


def _relative_error(value: float | None, real: float) -> float | None:
    """Return the error, %; None without a value or for a true value of zero."""
    return None if value is None or real == 0 else 100 * abs(value - real) / abs(real)


LABELS = {**TITLES, TRUTH: "Truth"}


def equation_table(residuals: Sequence[EquationResidual]) -> Table:
    """Return Appendix B's check of the equation of motion."""
    return Table(
        name="appendix_b",
        title="Appendix B: residual of the equation of motion",
        caption=(
            "Root mean square of y − K φ at the true parameters on noise-free logs, norm per "
            "sample. With friction, only samples at which no joint may stick count. The second "
            "value is the order of magnitude that the thesis states."
        ),
        headings=(Column("Robot"), Column("Model"), Column("Contact forces")),
        columns=(Column("RMSE", "N, Nm"),),
        rows=tuple(
            TableRow(
                text_cells(one.robot, one.model, one.wrenches),
                (Cell(one.rmse, EQUATION_RESIDUALS.get((one.robot, one.model, one.wrenches))),),
            )
            for one in residuals
        ),
        notes=(
            "The thesis reaches 1e-14 with friction in Simscape, whose contact forces are exact. "
            "In MuJoCo it reaches order 1 with recorded contact forces and no friction columns, "
            "and the second values with contact forces from Eq. 4.1.",
        ),
    )


def acceleration_table(checks: Mapping[str, AccelerationCheck], cutoff: float) -> Table:
    """Return the errors of filtered joint accelerations (Eq. 4.2)."""
    return Table(
        name="accelerations",
        title="Filtered joint accelerations",
        caption=(
            "True joint accelerations, and the error e_a of second derivatives of positions "
            f"filtered at {cutoff:g} Hz (thesis, Eq. 4.2); root mean square of the norm."
        ),
        headings=(Column("Log"),),
        columns=(Column("Acceleration", "rad/s²"), Column("e_a", "rad/s²")),
        rows=tuple(
            TableRow(
                text_cells(name), (Cell(one.rms), Cell(one.error, ACCELERATION_ERRORS.get(name)))
            )
            for name, one in checks.items()
        ),
    )


def realistic_table(means: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the errors of realistic predictions, by method."""

    def is_best(method: str, key: str) -> bool:
        smallest = min(found[key] for other, found in means.items() if other != TRUTH)
        return method != TRUTH and means[method][key] == smallest

    return Table(
        name="realistic",
        title="Errors of realistic predictions",
        caption=(
            "Means over the draws, with velocities filtered in real time, desired accelerations, "
            "and contact forces predicted by Eq. 4.1; “by wrenches”: torques from the measured "
            "contact forces instead. Bold: the smallest."
        ),
        headings=(Column("Method"),),
        columns=tuple(Column(metric.title, metric.unit) for metric in REALISTIC_METRICS),
        rows=tuple(
            TableRow(
                text_cells(LABELS[method]),
                tuple(
                    Cell(means[method][metric.key], best=is_best(method, metric.key))
                    for metric in REALISTIC_METRICS
                ),
            )
            for method in LABELS
            if method in means
        ),
    )


def balance_table(prior: str, runs: Mapping[str, Sequence[BalanceResult]]) -> Table:
    """Return the results of the balance controller with each method's models."""
    return Table(
        name=f"closed_loop_{prior.replace(' ', '').replace('%', 'percent').replace('±', '')}",
        title=f"Closed loop, priors {prior}",
        caption=(
            "CoM tracking and feed-forward share of the torques over the completed runs. A run "
            "fails with a fall, at a joint’s end stop, or if its model allows no torques."
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
            _balance_row(LABELS[method], runs[method])
            for method in LABELS
            if method in runs and (method == REFERENCE or runs[method])
        ),
    )


def _balance_row(name: str, runs: Sequence[BalanceResult]) -> TableRow:
    completed = [run for run in runs if not run.failure]
    tracking = [run.com_rmse_mm for run in completed]
    share = [100 * run.feed_forward_share for run in completed]
    causes = sorted({run.failure for run in runs if run.failure})
    return TableRow(
        text_cells(name),
        (
            Cell(text=f"{len(completed)} of {len(runs)}"),
            Cell(float(np.median(tracking)) if tracking else None),
            Cell(max(tracking) if tracking else None),
            Cell(float(np.median(share)) if share else None),
            Cell(text="; ".join(causes) or "—"),
        ),
    )
