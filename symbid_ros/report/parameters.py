"""The chosen estimate as rows of text, grouped by link."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.numerals import ABSENT, fixed, shared_decimals

OTHER = "Joints"


@dataclass(frozen=True)
class ParameterRow:
    """One parameter, every field ready to print."""

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
        The link.
    possible : bool
        Whether a body can have these inertias; True for joints.
    summary : str
        What is worth knowing before the table is opened.
    rows : tuple of ParameterRow
        In the estimate's order.
    """

    name: str
    possible: bool
    summary: str
    rows: tuple[ParameterRow, ...]


def parameter_groups(estimate: Estimate) -> tuple[ParameterGroup, ...]:
    """Return one group for each link, in order, then one for what belongs to joints."""
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
    # The prior sets the decimals: an estimate gone astray must not hide its own size in zeros.
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
