"""Formatted rows of the chosen estimate: numbers of the verdict, links and parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from symbid_ros.estimation.alarms import SUSPICIOUS_NOISE, SUSPICIOUS_WHITENESS
from symbid_ros.estimation.estimate import Estimate, HoldOut
from symbid_ros.estimation.unexplained import SMALL, SMALL_OF_OWN
from symbid_ros.estimation.verdict import EstimatedQuantity, Verdict
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.formatting import ABSENT, fixed, shared_decimals, significant, with_std

NOTHING: Mapping[str, float] = MappingProxyType({})

END = "the model has the friction at the end of the log"
UPRIGHT = np.cos(np.radians(0.5))
LARGEST_COM_STD = 1.0  # m; a larger deviation says nothing more


@dataclass(frozen=True)
class SummaryEntry:
    """A number of the verdict with its name, its meaning and the page that explains it."""

    name: str
    value: str
    meaning: str
    is_alarm: bool = False
    page: str = ""


def verdict_entries(estimate: Estimate) -> tuple[SummaryEntry, ...]:
    """Return the numbers of the whole estimate; empty if its method gives no verdict."""
    verdict = estimate.verdict
    if verdict is None:
        return ()
    scale, white, noise = verdict.prior_scale, verdict.whiteness, verdict.noise_share
    terms = estimate.describe_terms()
    return (
        SummaryEntry("Method", estimate.method, "", page="theory.html"),
        SummaryEntry("Rows", describe_window(verdict, estimate.samples), ""),
        *(
            [SummaryEntry("Joint terms", terms, "; ".join(estimate.remarks), page="options.html")]
            if terms
            else []
        ),
        *_mounting_entries(estimate),
        *(
            [SummaryEntry("Changing friction", changes, END, page="theory.html")]
            if (changes := "; ".join(estimate.describe_warming()))
            else []
        ),
        *_holdout_entries(estimate.holdout),
        SummaryEntry(
            "Effective parameters",
            f"{significant(verdict.effective)} of {estimate.identified}",
            "sum, over all combinations, of the share of the variance that the data removed; "
            f"{significant(verdict.gain)} bits gained in total",
        ),
        SummaryEntry(
            "Prior scale",
            significant(scale),
            "factor on the prior’s standard deviations that fits the data best; alarm above "
            f"{verdict.largest_prior_scale:g}",
            is_alarm=scale > verdict.largest_prior_scale,
            page="errors.html",
        ),
        *_mass_scale_entries(verdict, floating=estimate.is_floating),
        SummaryEntry(
            "Whiteness",
            significant(white) if white > 0 else ABSENT,
            f"of the residuals, at most 1 for white noise; alarm above {SUSPICIOUS_WHITENESS:g} "
            "unless the unexplained force is small"
            if white > 0
            else "of the residuals is not known: the rows have windows of one length only",
            is_alarm=verdict.is_coloured and white > SUSPICIOUS_WHITENESS,
            page="errors.html",
        ),
        *_unexplained_entries(verdict),
        SummaryEntry(
            "Noise in the motion",
            f"{significant(100 * noise)} %",
            "of the apparent information about the combination with most noise; alarm above "
            f"{100 * SUSPICIOUS_NOISE:g} %",
            is_alarm=noise > SUSPICIOUS_NOISE,
        ),
    )


def _unexplained_entries(verdict: Verdict) -> tuple[SummaryEntry, ...]:
    if not verdict.unexplained:
        return ()
    worst = verdict.unexplained[0]
    share, small = worst.share, SMALL
    if worst.is_clear_in_weak_joint:
        share, small = worst.own_share, SMALL_OF_OWN
    return (
        SummaryEntry(
            "Unexplained force",
            f"{significant(100 * share)} %",
            f"at most, apart from noise: {worst}; small below {100 * small:g} %",
            is_alarm=verdict.is_coloured,
        ),
    )


def _mass_scale_entries(verdict: Verdict, *, floating: bool) -> tuple[SummaryEntry, ...]:
    if not verdict.has_open_scale:
        return ()
    checkable = " without a weighing" if floating else ""
    if floating and verdict.weighing_std > 0:
        std = significant(verdict.weighing_std)
        checkable = f" by a weighing with a standard deviation of {std} kg"
    return (
        SummaryEntry(
            "Mass scale",
            f"± {significant(100 * verdict.mass_scale)} %",
            f"not checkable{checkable}: a gain error that all force and effort sensors have in "
            "common leaves no residual",
        ),
    )


def _mounting_entries(estimate: Estimate) -> tuple[SummaryEntry, ...]:
    """Return how gravity points on a fixed base that does not stand upright."""
    if estimate.gravity is None or not any(estimate.gravity):
        return ()
    x, y, z = np.array(estimate.gravity) / np.linalg.norm(estimate.gravity)
    if -z > UPRIGHT:
        return ()
    return (
        SummaryEntry(
            "Gravity", f"along ({x:.3f}, {y:.3f}, {z:.3f})", "in the base’s axes", page="data.html"
        ),
    )


def _holdout_entries(holdout: HoldOut | None) -> tuple[SummaryEntry, ...]:
    if holdout is None:
        return ()
    meaning = (
        "predicted by a trial identification that left them out"
        if holdout.seconds
        else "no trial identification"
    )
    is_bad = holdout.advice in ("worse", "unfit")
    return (SummaryEntry("Held out", holdout.summary, meaning, is_alarm=is_bad),)


def describe_window(verdict: Verdict, samples: int) -> str:
    """Describe the number of rows per coordinate and their averaging windows."""
    if verdict.window == 0:
        return f"{samples} rows of each coordinate, at single instants"
    return (
        f"{samples} rows of each coordinate, averaged over windows of {1e3 * verdict.window:g} ms"
    )


@dataclass(frozen=True)
class LinkRow:
    """Information gained about a link; ``share`` is its gain in % of the largest gain."""

    name: str
    determined: str
    mass: str
    is_mass_measured: bool
    com: str  # standard deviation of the centre of mass, mm
    gain: str
    share: float


def link_rows(estimate: Estimate, com_std: Mapping[str, float] = NOTHING) -> tuple[LinkRow, ...]:
    """Return the links in the model's order; empty if the method gives no verdict.

    ``com_std`` has the standard deviation of each link's centre of mass, m.
    """
    gains = estimate.verdict.link_gain if estimate.verdict is not None else {}
    largest = max(gains.values(), default=0.0)
    position = {name: index for index, name in enumerate(estimate.names)}
    rows = []
    for link, gain in gains.items():
        own = [position[f"{link}/{kind}"] for kind in PARAMETERS]
        count = ABSENT
        if estimate.determined is not None:
            count = f"{int(np.count_nonzero(estimate.determined[own]))} of {len(own)}"
        std = 0.0 if estimate.std is None else float(estimate.std[own[0]])
        share = round(100 * gain / largest, 1) if largest > 0 else 0.0
        mass = with_std(float(estimate.value[own[0]]), std)
        com = com_std.get(link)
        text = ABSENT if com is None else significant(1e3 * com, 2)
        if com is not None and com > LARGEST_COM_STD:
            text = f"> {1e3 * LARGEST_COM_STD:g}"
        measured = estimate.determined is None or bool(estimate.determined[own[0]])
        rows.append(LinkRow(link, count, mass, measured, text, f"{gain:.1f}", share))
    return tuple(rows)


OTHER = "Joints"


@dataclass(frozen=True)
class ParameterRow:
    """A parameter as formatted text."""

    name: str
    unit: str
    value: str
    prior: str
    std: str
    determined: str


@dataclass(frozen=True)
class ParameterGroup:
    """The parameters of one link, or those of all joints, in the estimate's order."""

    name: str  # of the link, or Joints
    possible: bool  # whether the inertia is physically possible; True for joints
    summary: str  # shown while the table is closed
    rows: tuple[ParameterRow, ...]


def identified_base(estimate: Estimate) -> tuple[EstimatedQuantity, ...]:
    """Return the base parameters without joint terms that the data do not need."""
    if estimate.verdict is None:
        return ()
    return tuple(one for one in estimate.verdict.base if one.name not in estimate.fixed)


def parameter_groups(estimate: Estimate) -> tuple[ParameterGroup, ...]:
    """Return one group for each link, in order, then one for the joint parameters.

    Joint terms that the data do not need are left out.
    """
    members: dict[str, list[int]] = {}
    fixed = estimate.fixed
    for index, name in enumerate(estimate.names):
        if name in fixed:
            continue
        owner, _, kind = name.rpartition("/")
        members.setdefault(owner if kind in PARAMETERS else "", []).append(index)
    joints = members.pop("", [])
    groups = [_group(estimate, link, indices) for link, indices in members.items()]
    if joints:
        groups.append(_group(estimate, "", joints))
    return tuple(groups)


def _group(estimate: Estimate, link: str, indices: list[int]) -> ParameterGroup:
    rows = tuple(_row(estimate, i, indices, link) for i in indices)
    parts = []
    if link and rows[0].name == PARAMETERS[0]:
        mass = indices[0]
        std = 0.0 if estimate.std is None else float(estimate.std[mass])
        before = significant(float(estimate.prior[mass]), 4)
        text = f"{with_std(float(estimate.value[mass]), std)} kg, original {before} kg"
        if estimate.determined is not None and not estimate.determined[mass]:
            text += ", not measured"
        parts.append(text)
    if estimate.determined is not None:
        count = int(np.count_nonzero(estimate.determined[indices]))
        parts.append(f"{count} of {len(indices)} parameters determined")
    return ParameterGroup(
        name=link or OTHER,
        possible=estimate.consistent.get(link, True),
        summary="; ".join(parts),
        rows=rows,
    )


def _row(estimate: Estimate, index: int, indices: list[int], link: str) -> ParameterRow:
    unit = estimate.units[index]
    std = None if estimate.std is None else float(estimate.std[index])
    if std is not None and np.isfinite(std) and std > 0:
        decimals = shared_decimals([std], 2)
    else:
        # The prior sets the decimals, so that a diverged estimate shows its true size.
        alike = [estimate.prior[i] for i in indices if estimate.units[i] == unit]
        decimals = shared_decimals(map(float, alike))
    determined = ABSENT
    if estimate.determined is not None:
        determined = "yes" if estimate.determined[index] else "no"
    name = estimate.names[index]
    return ParameterRow(
        name=name.removeprefix(f"{link}/") if link else name,
        unit=unit,
        value=fixed(float(estimate.value[index]), decimals),
        prior=fixed(float(estimate.prior[index]), decimals),
        std=fixed(std, decimals),
        determined=determined,
    )
