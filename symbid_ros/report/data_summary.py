"""Formatted summary of the chosen estimate: data, alarms, links, sensors and parameters."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.verdict import (
    SUSPICIOUS_NOISE,
    SUSPICIOUS_SCALE,
    SUSPICIOUS_WHITENESS,
    EstimatedQuantity,
    Verdict,
)
from symbid_ros.identification.intervals import IntervalSummary
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.formatting import ABSENT, fixed, shared_decimals, significant, with_std

_COEFFICIENT = re.compile(r"([+-])(\d\S*) ")


@dataclass(frozen=True)
class SummaryEntry:
    """A number of the verdict with its name and meaning."""

    name: str
    value: str
    meaning: str
    is_alarm: bool = False


@dataclass(frozen=True)
class LinkRow:
    """Information gained about a link; ``share`` is its gain in % of the largest gain."""

    name: str
    determined: str
    mass: str
    gain: str
    share: float


@dataclass(frozen=True)
class QuantityRow:
    """A quantity with its standard deviation."""

    name: str
    value: str
    unit: str
    determined: str


@dataclass(frozen=True)
class IntervalRow:
    """Standard deviation of a prediction, and coverage of the truth by its interval."""

    name: str
    std: str
    coverage: str


@dataclass(frozen=True)
class DataSummary:
    """Summary of what the data determine.

    Attributes
    ----------
    alarms : tuple of str
        One line per problem.
    entries : tuple of SummaryEntry
        Numbers of the whole estimate.
    links : tuple of LinkRow
        In the model's order.
    intervals : tuple of IntervalRow
        Empty without ground truth.
    sensors, base : tuple of QuantityRow
        Sensor errors, and base parameters.
    sensors_determined, base_determined : int
        How many of these the data determine.
    directions : tuple of str
        Determined directions of parameter space, best first.
    parameters : int
        Number of directions in total.
    """

    alarms: tuple[str, ...]
    entries: tuple[SummaryEntry, ...]
    links: tuple[LinkRow, ...]
    intervals: tuple[IntervalRow, ...]
    sensors: tuple[QuantityRow, ...]
    sensors_determined: int
    base: tuple[QuantityRow, ...]
    base_determined: int
    directions: tuple[str, ...]
    parameters: int


def summarise_data(
    estimate: Estimate, intervals: IntervalSummary | None = None
) -> DataSummary | None:
    """Return the summary of an estimate, None if its method gives no verdict."""
    verdict = estimate.verdict
    if verdict is None:
        return None
    return DataSummary(
        alarms=verdict.alarms,
        entries=_entries(estimate, verdict),
        links=_links(estimate, verdict),
        intervals=_intervals(intervals),
        sensors=_quantities(verdict.sensors),
        sensors_determined=sum(error.determined for error in verdict.sensors),
        base=_quantities(verdict.base),
        base_determined=sum(combination.determined for combination in verdict.base),
        directions=tuple(_COEFFICIENT.sub(_unbroken, one) for one in verdict.directions),
        parameters=len(estimate.names),
    )


def describe_window(verdict: Verdict, samples: int) -> str:
    """Describe the number of rows per coordinate and their averaging windows."""
    if verdict.window == 0:
        return f"{samples} rows of each coordinate, at single instants"
    return (
        f"{samples} rows of each coordinate, averaged over windows of {1e3 * verdict.window:g} ms"
    )


def _unbroken(coefficient: re.Match[str]) -> str:
    """Return a coefficient with a minus sign and a non-breaking space before its parameter."""
    sign = coefficient[1].replace("-", "−")
    return f"{sign}{coefficient[2]}\N{NO-BREAK SPACE}"


def _entries(estimate: Estimate, verdict: Verdict) -> tuple[SummaryEntry, ...]:
    scale, white, noise = verdict.prior_scale, verdict.whiteness, verdict.noise_share
    return (
        SummaryEntry("Rows", describe_window(verdict, estimate.samples), ""),
        SummaryEntry(
            "Effective parameters",
            f"{significant(verdict.effective)} of {len(estimate.names)}",
            f"{significant(verdict.gain)} bits gained in total",
        ),
        SummaryEntry(
            "Prior scale",
            significant(scale),
            "factor on the prior’s standard deviations that fits the data best; alarm above "
            f"{SUSPICIOUS_SCALE:g}",
            is_alarm=scale > SUSPICIOUS_SCALE,
        ),
        SummaryEntry(
            "Whiteness",
            significant(white) if white > 0 else ABSENT,
            f"of the residuals, at most 1 for white noise; alarm above {SUSPICIOUS_WHITENESS:g}",
            is_alarm=white > SUSPICIOUS_WHITENESS,
        ),
        SummaryEntry(
            "Noise in the motion",
            f"{significant(100 * noise)} %",
            "of the apparent information about the worst direction; alarm above "
            f"{100 * SUSPICIOUS_NOISE:g} %",
            is_alarm=noise > SUSPICIOUS_NOISE,
        ),
    )


def _links(estimate: Estimate, verdict: Verdict) -> tuple[LinkRow, ...]:
    largest = max(verdict.link_gain.values(), default=0.0)
    position = {name: index for index, name in enumerate(estimate.names)}
    rows = []
    for link, gain in verdict.link_gain.items():
        own = [position[f"{link}/{kind}"] for kind in PARAMETERS]
        count = ABSENT
        if estimate.determined is not None:
            count = f"{int(np.count_nonzero(estimate.determined[own]))} of {len(own)}"
        std = 0.0 if estimate.std is None else float(estimate.std[own[0]])
        share = round(100 * gain / largest, 1) if largest > 0 else 0.0
        mass = with_std(float(estimate.value[own[0]]), std)
        rows.append(LinkRow(link, count, mass, f"{gain:.1f}", share))
    return tuple(rows)


def _quantities(quantities: Sequence[EstimatedQuantity]) -> tuple[QuantityRow, ...]:
    return tuple(
        QuantityRow(
            quantity.name.replace(" - ", " − "),
            with_std(quantity.value, quantity.std),
            "relative" if quantity.unit == "1" else quantity.unit,
            "yes" if quantity.determined else "no",
        )
        for quantity in quantities
    )


def _intervals(summary: IntervalSummary | None) -> tuple[IntervalRow, ...]:
    if summary is None:
        return ()
    return (
        IntervalRow(
            "Centre of mass",
            f"{significant(summary.com_std_mm)} mm",
            f"{100 * summary.com_coverage:.0f} %",
        ),
        IntervalRow(
            "Joint torques",
            f"{significant(summary.torque_std)} Nm",
            f"{100 * summary.torque_coverage:.0f} %",
        ),
    )


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
    """The parameters of one link, or those of all joints.

    Attributes
    ----------
    name : str
        Name of the link, or ``Joints``.
    possible : bool
        Whether the inertia is physically possible; True for joints.
    summary : str
        Shown while the table is closed.
    rows : tuple of ParameterRow
        In the estimate's order.
    """

    name: str
    possible: bool
    summary: str
    rows: tuple[ParameterRow, ...]


def parameter_groups(estimate: Estimate) -> tuple[ParameterGroup, ...]:
    """Return one group for each link, in order, then one for the joint parameters."""
    members: dict[str, list[int]] = {}
    for index, name in enumerate(estimate.names):
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
        parts.append(f"{rows[0].value} kg, prior {rows[0].prior} kg")
    if estimate.determined is not None:
        count = int(np.count_nonzero(estimate.determined[indices]))
        parts.append(f"{count} of {len(indices)} determined")
    return ParameterGroup(
        name=link or OTHER,
        possible=estimate.consistent.get(link, True),
        summary="; ".join(parts),
        rows=rows,
    )


def _row(estimate: Estimate, index: int, indices: list[int], link: str) -> ParameterRow:
    unit = estimate.units[index]
    # The prior sets the decimals, so that a diverged estimate shows its true size.
    alike = [estimate.prior[i] for i in indices if estimate.units[i] == unit]
    decimals = shared_decimals(map(float, alike))
    std = None if estimate.std is None else float(estimate.std[index])
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
