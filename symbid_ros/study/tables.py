"""The thesis's tables with our figures in them, and one for studies that it did not make."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.formatting import ABSENT
from symbid_ros.study import thesis
from symbid_ros.study.comparison import filtered, listed
from symbid_ros.study.parameter_table import Draw, parameters
from symbid_ros.study.plan import Plan
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Scores
from symbid_ros.study.sheet import Cell, Column, Row, Sheet, beside
from symbid_ros.study.thesis import TITLES

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


def tables(plan: Plan, scores: Scores, draw: Draw | None = None) -> tuple[Sheet, ...]:
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
    made = [_with_metrics(sheet, plan.shown) for sheet in made]
    if draw is not None:
        made.append(parameters(draw))
    return tuple(made)


def techniques(methods: Iterable[str]) -> Sheet:
    """Return Table I: what each method scales, and what it does where the data say nothing."""
    return Sheet(
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
            Row((Cell(words=TITLES[method]),), tuple(Cell(words=word) for word in words))
            for method, words in TECHNIQUES.items()
            if method in _shown(methods)
        ),
    )


def best_over_filters(plan: Plan, scores: Scores, data: str, absolute: bool) -> Sheet:
    """Return Table II or, of absolute priors, Table 4.1: the least errors over the filters."""
    printed = thesis.table_4_1() if absolute else thesis.table_2()
    rows = []
    for spread in (str(one) for one in plan.priors if (one.kind == "absolute") == absolute):
        means = {method: scores.best(data, spread, method) for method in _shown(plan.methods)}
        rows += [
            Row(
                (Cell(words=spread), Cell(words=TITLES[method])),
                _figures(found, printed.best(thesis.DATA, spread, method), _least(means.values())),
            )
            for method, found in means.items()
            if found
        ]
    return Sheet(
        name=f"table_{'4_1' if absolute else '2'}_{_stem(data)}",
        title=f"Table {'4.1' if absolute else 'II'}: best over the filters, {data}",
        caption=BEST.format(draws=plan.iterations) + beside(rows),
        headings=(Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def every_filter(plan: Plan, scores: Scores, data: str) -> Sheet:
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
                (Cell(words=spread), Cell(words=TITLES[method]), _filter(method, cutoff)),
                _figures(
                    means,
                    thesis.table_c1().at(thesis.DATA, spread, method, cutoff),
                    _least(tried.values()),
                ),
            )
            for (method, cutoff), means in tried.items()
        ]
    return Sheet(
        name=f"table_c1_{_stem(data)}",
        title=f"Table C.1: every filter, {data}",
        caption=f"Means over {plan.iterations} priors. Bold: the least of one prior."
        + beside(rows),
        headings=(Column("Prior"), Column("Method"), Column("Filter", "Hz")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def comparison(plan: Plan, scores: Scores) -> Sheet:
    """Return the errors of every data set, prior and method."""
    rows = []
    for data in plan.data:
        for spread in map(str, plan.priors):
            means = {method: scores.best(data, spread, method) for method in _shown(plan.methods)}
            rows += [
                Row(
                    (Cell(words=data), Cell(words=spread), Cell(words=TITLES[method])),
                    _figures(found, {}, _least(means.values())),
                )
                for method, found in means.items()
                if found
            ]
    filters = ""
    if plan.truncated:
        names = listed(TITLES[method] for method in _shown(plan.truncated)[1:])
        filters = f"; rows of {names} {filtered(plan.filters[0])}"
    return Sheet(
        name="comparison",
        title="Comparison",
        caption=(
            BEST.format(draws=plan.iterations)
            if plan.truncated and len(plan.filters) > 1
            else f"Means over {plan.iterations} priors{filters}. Bold: the least of one prior."
        ),
        headings=(Column("Data"), Column("Prior"), Column("Method")),
        columns=COLUMNS,
        rows=tuple(rows),
    )


def _with_metrics(sheet: Sheet, shown: Sequence[str]) -> Sheet:
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
        return Cell(cutoff, words=f"{cutoff:g}" if cutoff else "none")
    return Cell(words=ABSENT if method == REFERENCE else "windows")


def _stem(data: str) -> str:
    return data.replace(" ", "_")
