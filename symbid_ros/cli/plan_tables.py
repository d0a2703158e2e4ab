"""Tables of a designed trajectory that commands print on the terminal."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from symbid_ros.cli.flags import flag
from symbid_ros.excitation.files import FILES
from symbid_ros.excitation.page import closest_links, contacts_used
from symbid_ros.excitation.plan import ExcitationPlan
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.options import spelled
from symbid_ros.report.formatting import significant


def print_plan(plan: ExcitationPlan, out: Path) -> None:
    """Print the limits that a trajectory uses and the deviations that it will leave."""
    console = Console(highlight=False)
    console.print(limits_table(plan))
    console.print(*(links_table(plan, part) for part in (slice(0, 4), slice(4, 10))), sep="\n")
    if plan.problem.parameters.terms:
        console.print(terms_table(plan))
    design = plan.problem.design
    lines = [
        f"{design.seconds:g} s, {design.seconds / design.series.period:g} periods of "
        f"{design.series.period:g} s, after {plan.approach:g} s from "
        f"{'the stance' if plan.contact_usage else 'any posture'} to the start",
        f"{int(plan.determined.sum())} of {len(plan.std)} parameters expected to be determined, "
        f"{plan.gain:.0f} bits to gain",
        *(f"assumed: {each}" for each in plan.problem.limits.assumed),
        *filter(None, [contacts_used(plan), closest_links(plan)]),
        *(f"not checked: {spelled(each, flag)}" for each in plan.problem.unchecked),
        f"wrote {out}/: {', '.join(name for name in FILES if (out / name).exists())}",
    ]
    for line in lines:
        console.print(Text(line), soft_wrap=True)


def limits_table(plan: ExcitationPlan) -> Table:
    """Return a table of the share of each limit that each joint uses."""
    usage = plan.usage()
    table = Table(title=f"{plan.joints.model.name}: used of each limit, %", title_justify="left")
    table.add_column("joint", overflow="fold")
    for kind in usage:
        table.add_column(kind, justify="right")
    for index, name in enumerate(plan.joints.names):
        table.add_row(Text(name), *(f"{100 * shares[index]:.0f}" for shares in usage.values()))
    return table


def links_table(plan: ExcitationPlan, part: slice) -> Table:
    """Return a table of the expected deviations of some parameters of each link, SI units."""
    table = Table(
        title="expected standard deviations, SI units; in brackets: not determined",
        title_justify="left",
        pad_edge=False,
    )
    table.add_column("link", overflow="fold")
    for name in PARAMETERS[part]:
        table.add_column(name, justify="right", no_wrap=True)
    parameters = plan.problem.parameters
    std, determined = (
        values[: parameters.inertial].reshape(-1, 10)[:, part]
        for values in (plan.std, plan.determined)
    )
    for link, row, known in zip(parameters.link_names, std, determined, strict=True):
        table.add_row(Text(link), *map(_deviation, row.tolist(), known.tolist()))
    return table


def terms_table(plan: ExcitationPlan) -> Table:
    """Return a table of the expected deviation of each joint term."""
    parameters = plan.problem.parameters
    table = Table(pad_edge=False)
    table.add_column("joint", overflow="fold")
    for term in parameters.term_columns:
        table.add_column(term, justify="right", no_wrap=True)
    for place, joint in enumerate(parameters.joints.tolist()):
        columns = [columns.start + place for columns in parameters.term_columns.values()]
        table.add_row(
            Text(parameters.model.joint_names[joint]),
            *(_deviation(plan.std[column], plan.determined[column]) for column in columns),
        )
    return table


def _deviation(std: float, determined: bool | np.bool_) -> Text:
    text = significant(std, 2)
    return Text(text) if determined else Text(f"({text})", style="dim")
