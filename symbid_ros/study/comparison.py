"""How two errors compare, how often one is ahead, and how that is worded."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.report.content import METRICS as TITLED
from symbid_ros.report.formatting import significant
from symbid_ros.study.scores import METRICS
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
