"""Comparisons of mean errors, on which conclusions are checked, and their wording."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.formatting import significant
from symbid_ros.study.plan import PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Scores
from symbid_ros.study.thesis import TITLES

# Relative difference below which two errors tie: means over twenty priors scatter by a few percent.
TIE = 0.05
MARGIN = f"{100 * TIE:g} %"
NOUNS = dict(
    zip(
        METRICS,
        ("generalised force", "joint torque", "CoM position", "CoM momentum", "parameters"),
        strict=True,
    )
)
FORCE, COM, PARAMETERS = "gen_force_rmse", "com_position_rmse_mm", "parameter_error_pct"
# The methods of the thesis.
FOUR = ("ols", "wls_r", "wls_c", "wls_rc")
# Mean parameter error above which a prior is a poor scale of the columns, %.
MISLEADING = 100.0


@dataclass(frozen=True)
class Conclusion:
    """A claim and the result of its check.

    Attributes
    ----------
    claim : str
        The claim and its source.
    holds : bool or None
        Whether the claim holds; None: in part.
    finding : str
        What the numbers show.
    explanation : str
        Reasons that the numbers show, if the claim does not hold fully.
    """

    claim: str
    holds: bool | None
    finding: str
    explanation: str

    @property
    def verdict(self) -> str:
        """`holds` in words."""
        return {True: "holds", False: "does not hold", None: "holds in part"}[self.holds]


def compare(own: float, other: float) -> int:
    """Return 1 if own is smaller, -1 if it is larger, 0 if they tie."""
    return int(own * (1 + TIE) < other) - int(other * (1 + TIE) < own)


def holds_by_share(supporting: int, total: int) -> bool | None:
    """Return True if all cases support a claim, None if at least half do, otherwise False."""
    if supporting == total:
        return True
    return None if 2 * supporting >= total and supporting else False


def holds_by_order(orders: Sequence[int]) -> bool | None:
    """Return True if all orders of :func:`compare` are at least 0, None if at least half are.

    Otherwise, or if no order is 1, the claim does not hold: False.
    """
    if 1 not in orders:
        return False
    return holds_by_share(len(orders) - orders.count(-1), len(orders))


@dataclass(frozen=True)
class Comparison:
    """One error of a method, and the value with which it is compared.

    Attributes
    ----------
    place : str
        The condition of the comparison, such as the prior.
    metric : str
        Name of the error.
    own, other : float
        The two values.
    other_method : str
        The method of the other value.
    """

    place: str
    metric: str
    own: float
    other: float
    other_method: str = ""

    @property
    def order(self) -> int:
        """1 if own is smaller, -1 if it is larger, 0 if they tie."""
        return compare(self.own, self.other)


@dataclass(frozen=True)
class ComparisonSet:
    """Comparisons that decide one claim."""

    comparisons: tuple[Comparison, ...]

    def __len__(self) -> int:
        return len(self.comparisons)

    def with_order(self, order: int) -> tuple[Comparison, ...]:
        """Return the comparisons of one order."""
        return tuple(one for one in self.comparisons if one.order == order)

    @property
    def holds(self) -> bool | None:
        """Whether own is smaller, as :func:`holds_by_order` decides."""
        return holds_by_order([one.order for one in self.comparisons])


@dataclass(frozen=True)
class Evidence:
    """The mean errors and the row residuals on one data set.

    Attributes
    ----------
    scores : Scores
        Means of the study.
    data : str
        The data set.
    priors : tuple of PriorSpread
        How priors were drawn.
    row_errors : dict of float to float
        RMS norm of y - K φ at the true parameters, N and Nm, by cutoff in Hz. It is caused by
        noise and filtering.
    """

    scores: Scores
    data: str
    priors: tuple[PriorSpread, ...]
    row_errors: Mapping[float, float] = field(default_factory=dict)

    def best(self, prior: str, method: str) -> Mapping[str, float]:
        """Return the smallest errors over the filters; empty if one is missing or not finite."""
        return _complete(self.scores.best(self.data, prior, method))

    def at(self, prior: str, method: str, cutoff: float) -> Mapping[str, float]:
        """Return the errors with one filter; empty if one is missing or not finite."""
        return _complete(self.scores.at(self.data, prior, method, cutoff))

    def priors_with(self, absolute: bool, *methods: str) -> list[str]:
        """Return the priors of one kind, ascending, for which all these methods have errors."""
        kind = "absolute" if absolute else "percent"
        spreads = sorted(
            (spread for spread in self.priors if spread.kind == kind), key=lambda one: one.amount
        )
        return [
            str(spread)
            for spread in spreads
            if all(self.best(str(spread), method) for method in methods)
        ]

    def compare(
        self,
        own: str,
        others: Sequence[str],
        priors: Iterable[str],
        *,
        errors: Callable[[str, str], Mapping[str, float]] | None = None,
        metrics: Sequence[str] = METRICS,
    ) -> ComparisonSet:
        """Compare a method's errors with the smallest of other methods.

        Parameters
        ----------
        own, others : str, sequence of str
            The methods.
        priors : iterable of str
            Priors for which all of the methods have errors.
        errors : callable, optional
            Returns errors by prior and method; default: the smallest over the filters.
        metrics : sequence of str, optional
            The errors to compare.
        """
        comparisons = []
        errors = errors or self.best
        for prior in priors:
            mine = errors(prior, own)
            theirs = {other: errors(prior, other) for other in others}
            for metric in metrics:
                best = min(theirs, key=lambda other: theirs[other][metric])
                comparison = Comparison(prior, metric, mine[metric], theirs[best][metric], best)
                comparisons.append(comparison)
        return ComparisonSet(tuple(comparisons))

    def describe_errors(self, prior: str, methods: Iterable[str], metric: str = COM) -> str:
        """Return one error of several methods, such as "CoM position at ±25 %: OLS 20 mm, …"."""
        errors = [
            f"{TITLES[method]} {format_error(metric, self.best(prior, method)[metric])}"
            for method in methods
        ]
        return f"{NOUNS[metric]} at {prior}: {', '.join(errors)}"

    def describe_ranks(self, prior: str, methods: Iterable[str]) -> str:
        """Return the number of singular values that methods keep, empty if it is unknown."""
        ranks = [
            f"{TITLES[method]} {significant(errors[RANK])}"
            for method in methods
            if RANK in (errors := self.best(prior, method))
        ]
        return f"singular values kept at {prior}: {', '.join(ranks)}" if ranks else ""

    def describe_rank_effect(self, prior: str, methods: Iterable[str]) -> str:
        """Return the ranks, and whether a higher rank improves the force but not the CoM."""
        errors = {method: self.best(prior, method) for method in methods}
        ranked = sorted((e for e in errors.values() if RANK in e), key=lambda one: one[RANK])
        text = self.describe_ranks(prior, errors)
        if len(ranked) > 1:
            few, many = ranked[0], ranked[-1]
            if many[FORCE] < few[FORCE] and many[COM] > few[COM]:
                text += (
                    f"; from the fewest to the most, the error in {NOUNS[FORCE]}, by which the "
                    f"number is selected, decreases from {format_error(FORCE, few[FORCE])} to "
                    f"{format_error(FORCE, many[FORCE])}, while that in {NOUNS[COM]} increases "
                    f"from {format_error(COM, few[COM])} to {format_error(COM, many[COM])}"
                )
        return text

    def describe_column_scales(self, prior: str) -> str:
        """Return the error of the priors that scale the columns, empty if it is small."""
        error = self.best(prior, REFERENCE).get(PARAMETERS, 0.0)
        if error < MISLEADING:
            return ""
        return (
            f"the prior's parameters, which scale the columns, have a mean error of "
            f"{format_error(PARAMETERS, error)}"
        )

    def describe_row_errors(self) -> str:
        """Return the filters with the smallest and the largest row residual, empty without any."""
        finite = {cutoff: e for cutoff, e in self.row_errors.items() if math.isfinite(e)}
        if not finite:
            return ""
        ends = sorted({min(finite, key=finite.__getitem__), max(finite, key=finite.__getitem__)})
        parts = [
            f"{significant(finite[cutoff])} N & Nm RMS {describe_filter(cutoff)}" for cutoff in ends
        ]
        return f"the residual of the rows at the true parameters is {enumerate_words(parts)}"


def _complete(means: Mapping[str, float]) -> Mapping[str, float]:
    return means if all(math.isfinite(means.get(name, math.nan)) for name in METRICS) else {}


def middle(priors: Sequence[str]) -> str:
    """Return the prior of medium width, which serves as an example."""
    return priors[len(priors) // 2]


def format_range(values: Iterable[float]) -> str:
    """Return the smallest and the largest value in words."""
    ordered = sorted(values)
    low, high = significant(ordered[0], 2), significant(ordered[-1], 2)
    return low if low == high else f"{low} to {high}"


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(list(values)))))


def format_error(metric: str, value: float) -> str:
    """Return an error with its unit."""
    unit = TITLED[METRICS.index(metric)].unit.replace(",", " &")
    return f"{significant(value)} {unit}"


def describe_filter(cutoff: float) -> str:
    """Return a filter in words."""
    return f"filtered at {cutoff:g} Hz" if cutoff else "unfiltered"


def conclude(claim: str, holds: bool | None, finding: str, *reasons: str) -> Conclusion:
    """Return a conclusion, whose explanation joins the nonempty reasons if it does not hold."""
    text = "" if holds else "; ".join(filter(None, reasons))
    explanation = f"{text[0].upper()}{text[1:]}." if text else ""
    return Conclusion(claim, holds, finding, explanation)


def enumerate_errors(comparisons: Iterable[Comparison], with_method: bool = False) -> str:
    """Return the errors and their priors as text, grouped by prior and other method."""
    groups: dict[tuple[str, str], list[str]] = {}
    for one in comparisons:
        key = (one.place, one.other_method if with_method else "")
        groups.setdefault(key, []).append(one.metric)
    places_of: dict[tuple[tuple[str, ...], str], list[str]] = {}
    for (place, method), metrics in groups.items():
        places_of.setdefault((tuple(metrics), method), []).append(place)
    parts = []
    for (names, method), places in places_of.items():
        every = len(names) == len(METRICS)
        errors = "every error" if every else enumerate_words(NOUNS[m] for m in names)
        start = f"{TITLES[method]} in " if method else ""
        parts.append(f"{start}{errors} at {enumerate_words(places)}")
    return ", ".join(parts)


def describe_lead(name: str, place: str, compared: ComparisonSet) -> str:
    """Return how often a method is ahead and how often it ties, and where others are ahead.

    ``place`` is the predicate of the sentence, such as "best of the four".
    """
    better, tied, worse = (compared.with_order(order) for order in (1, 0, -1))
    text = f"{name} is {place} in {len(better)} of {len(compared)} errors"
    if tied:
        text += f", within {MARGIN} in {len(tied)}"
    return text + (f", behind {enumerate_errors(worse, with_method=True)}" if worse else "")
