"""What a claim is examined on, and what comes of it."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.formatting import significant
from symbid_ros.study.plan import Spread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Scores
from symbid_ros.study.thesis import TITLES

# Means over twenty priors scatter by a few percent: what differs by less is called a tie.
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


def order(own: float, other: float) -> int:
    """Return 1 where own is the smaller one, -1 where it is the larger, 0 where they tie."""
    return int(own * (1 + TIE) < other) - int(other * (1 + TIE) < own)


def share(supporting: int, examined: int) -> bool | None:
    """Return True where all support a claim, None where at least half do, otherwise False."""
    if supporting == examined:
        return True
    return None if 2 * supporting >= examined and supporting else False


def leads(orders: Sequence[int]) -> bool | None:
    """Return True if ahead or tied throughout, None in at least half, False if ahead nowhere."""
    if 1 not in orders:
        return False
    return share(len(orders) - orders.count(-1), len(orders))


@dataclass(frozen=True)
class Comparison:
    """One error of one method beside another figure.

    Attributes
    ----------
    place : str
        Where, such as the prior.
    metric : str
        Which error.
    own, other : float
        The two figures.
    rival : str
        Whose the other one is.
    """

    place: str
    metric: str
    own: float
    other: float
    rival: str = ""

    @property
    def order(self) -> int:
        """1 where own is the smaller one, -1 where it is the larger, 0 where they tie."""
        return order(self.own, self.other)


@dataclass(frozen=True)
class Tally:
    """Comparisons, sorted by their outcome."""

    comparisons: tuple[Comparison, ...]

    def __len__(self) -> int:
        return len(self.comparisons)

    def of(self, order: int) -> tuple[Comparison, ...]:
        """Return those with this outcome."""
        return tuple(one for one in self.comparisons if one.order == order)

    @property
    def holds(self) -> bool | None:
        """Whether own is better, as `leads` says."""
        return leads([one.order for one in self.comparisons])


def factors(values: Iterable[float]) -> str:
    """Return a range of factors in words."""
    found = sorted(values)
    low, high = significant(found[0], 2), significant(found[-1], 2)
    return low if low == high else f"{low} to {high}"


def mean_factor(values: Iterable[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(list(values)))))


def quantity(metric: str, value: float) -> str:
    """Return an error with its unit."""
    unit = TITLED[METRICS.index(metric)].unit.replace(",", " &")
    return f"{significant(value)} {unit}"


def filtered(cutoff: float) -> str:
    """Return a filter in words."""
    return f"filtered at {cutoff:g} Hz" if cutoff else "unfiltered"


def listed(words: Iterable[str]) -> str:
    """Return words as an enumeration."""
    found = list(words)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} and {found[-1]}"


def unless(holds: bool | None, *reasons: str) -> str:
    """Return the reasons that there are as one sentence, none for a claim that holds."""
    found = "" if holds else "; ".join(filter(None, reasons))
    return f"{found[0].upper()}{found[1:]}." if found else ""


def errors_at(comparisons: Iterable[Comparison], with_rival: bool = False) -> str:
    """Return which errors in which places, those of one prior (and rival) together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for one in comparisons:
        key = (one.place, one.rival if with_rival else "")
        groups.setdefault(key, []).append(one.metric)
    alike: dict[tuple[tuple[str, ...], str], list[str]] = {}
    for (place, rival), metrics in groups.items():
        alike.setdefault((tuple(metrics), rival), []).append(place)
    parts = []
    for (names, rival), places in alike.items():
        what = "every error" if len(names) == len(METRICS) else listed(NOUNS[m] for m in names)
        lead = f"{TITLES[rival]} in " if rival else ""
        parts.append(f"{lead}{what} at {listed(places)}")
    return ", ".join(parts)


def standing(name: str, place: str, tally: Tally) -> str:
    """Return how often a method has a place, where it ties, and where another has it."""
    better, tied, worse = tally.of(1), tally.of(0), tally.of(-1)
    text = f"{name} is {place} in {len(better) or 'none'} of {len(tally)} errors"
    if tied:
        text += f", within {MARGIN} in {len(tied)}"
    return text + (f", behind {errors_at(worse, with_rival=True)}" if worse else "")


# The thesis's methods of estimation.
FOUR = ("ols", "wls_r", "wls_c", "wls_rc")
# %: priors further off than the parameters are large scale columns at random.
MISLEADING = 100.0


@dataclass(frozen=True)
class Conclusion:
    """One claim, and what the numbers say of it.

    Attributes
    ----------
    claim : str
        What is claimed, and where.
    holds : bool or None
        Whether it does; None: in part.
    sentence : str
        What the numbers say.
    because : str
        Where it does not hold throughout, what the numbers show of the reason.
    """

    claim: str
    holds: bool | None
    sentence: str
    because: str = ""

    @property
    def verdict(self) -> str:
        """The outcome in words."""
        return {True: "holds", False: "does not hold", None: "holds in part"}[self.holds]


@dataclass(frozen=True)
class Evidence:
    """Measurements on the rows that tell why a method fails.

    Attributes
    ----------
    row_error : dict of float to float
        By cutoff in Hz, rms over rows of y - K φ at the true parameters, N and Nm: how far noise
        and filtering make the training rows inconsistent.
    """

    row_error: Mapping[float, float] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """The best and the worst of the filters, empty without measurements."""
        finite = {cutoff: e for cutoff, e in self.row_error.items() if math.isfinite(e)}
        if not finite:
            return ""
        ends = sorted({min(finite, key=finite.__getitem__), max(finite, key=finite.__getitem__)})
        parts = [f"{significant(finite[cutoff])} N & Nm rms {filtered(cutoff)}" for cutoff in ends]
        return f"with the true parameters the rows are off by {listed(parts)}"


@dataclass(frozen=True)
class Examination:
    """The means on one data set.

    Attributes
    ----------
    scores : Scores
        All means.
    data : str
        The data set.
    priors : tuple of Spread
        How priors were drawn.
    evidence : Evidence
        What else was measured.
    """

    scores: Scores
    data: str
    priors: tuple[Spread, ...]
    evidence: Evidence

    def best(self, prior: str, method: str) -> Mapping[str, float]:
        """Return the least errors over the filters; empty where one is missing or not finite."""
        return _complete(self.scores.best(self.data, prior, method))

    def at(self, prior: str, method: str, cutoff: float) -> Mapping[str, float]:
        """Return the errors with one filter; empty where one is missing or not finite."""
        return _complete(self.scores.at(self.data, prior, method, cutoff))

    def with_prior(self, absolute: bool, *methods: str) -> list[str]:
        """Return the priors of one kind, ascending, with which all these methods have errors."""
        kind = "absolute" if absolute else "percent"
        spreads = sorted(
            (spread for spread in self.priors if spread.kind == kind), key=lambda one: one.amount
        )
        return [
            str(spread)
            for spread in spreads
            if all(self.best(str(spread), method) for method in methods)
        ]

    def against(
        self,
        own: str,
        rivals: Sequence[str],
        priors: Iterable[str],
        *,
        figures: Callable[[str, str], Mapping[str, float]] | None = None,
        metrics: Sequence[str] = METRICS,
    ) -> Tally:
        """Compare a method's errors with the least of its rivals'.

        Parameters
        ----------
        own, rivals : str, sequence of str
            The methods.
        priors : iterable of str
            Where; all of the methods have their errors there.
        figures : callable, optional
            Errors by prior and method; the least over the filters by default.
        metrics : sequence of str, optional
            Which errors.
        """
        found = []
        take = figures or self.best
        for prior in priors:
            mine = take(prior, own)
            theirs = {rival: take(prior, rival) for rival in rivals}
            for metric in metrics:
                rival = min(theirs, key=lambda one: theirs[one][metric])
                found.append(Comparison(prior, metric, mine[metric], theirs[rival][metric], rival))
        return Tally(tuple(found))

    def figures(self, prior: str, methods: Iterable[str], metric: str = COM) -> str:
        """Return one error of several methods, such as "CoM position at ±25 %: OLS 20 mm, …"."""
        told = [
            f"{TITLES[method]} {quantity(metric, self.best(prior, method)[metric])}"
            for method in methods
        ]
        return f"{NOUNS[metric]} at {prior}: {', '.join(told)}"

    def ranks(self, prior: str, methods: Iterable[str]) -> str:
        """Return how many singular values methods keep, empty where that is not known."""
        told = [
            f"{TITLES[method]} {significant(found[RANK])}"
            for method in methods
            if RANK in (found := self.best(prior, method))
        ]
        return f"singular values kept at {prior}: {', '.join(told)}" if told else ""

    def bought(self, prior: str, methods: Iterable[str]) -> str:
        """Return :meth:`ranks`, and whether more of them serve the force alone, that chose them."""
        found = {method: self.best(prior, method) for method in methods}
        kept = sorted((f for f in found.values() if RANK in f), key=lambda one: one[RANK])
        text = self.ranks(prior, found)
        if len(kept) > 1:
            few, many = kept[0], kept[-1]
            if many[FORCE] < few[FORCE] and many[COM] > few[COM]:
                text += (
                    f"; from the fewest to the most of them the {NOUNS[FORCE]}, which chose them, "
                    f"improves from {quantity(FORCE, few[FORCE])} to "
                    f"{quantity(FORCE, many[FORCE])}, while the {NOUNS[COM]} worsens from "
                    f"{quantity(COM, few[COM])} to {quantity(COM, many[COM])}"
                )
        return text

    def wrong_scales(self, prior: str) -> str:
        """Return how far priors are off that scale the columns, empty where that is little."""
        off = self.best(prior, REFERENCE).get(PARAMETERS, 0.0)
        if off < MISLEADING:
            return ""
        return (
            f"the prior's parameters are off by {quantity(PARAMETERS, off)} on average, and so are "
            "the scales of the columns"
        )


def _complete(means: Mapping[str, float]) -> Mapping[str, float]:
    return means if all(math.isfinite(means.get(name, math.nan)) for name in METRICS) else {}


def middle(priors: Sequence[str]) -> str:
    """Return the prior whose figures are told as an example."""
    return priors[len(priors) // 2]
