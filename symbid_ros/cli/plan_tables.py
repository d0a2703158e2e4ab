"""Tables of a designed trajectory that commands print on the terminal."""

import logging
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from symbid_ros.cli.fitted_tables import print_table, written_files
from symbid_ros.cli.flags import flag
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.excitation.files import FILES
from symbid_ros.excitation.page import closest_links, contacts_used
from symbid_ros.excitation.plan import ExcitationPlan
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.options import spelled
from symbid_ros.report.formatting import counted, significant

logger = logging.getLogger(__name__)

MOMENTS = 4  # number of a link's first parameters: mass and first moments


def print_plan(plan: ExcitationPlan, out: Path) -> None:
    """Print the limits that a trajectory uses and the deviations that it will leave."""
    console = Console(highlight=False)
    print_usage(console, plan)
    print_link_deviations(console, plan)
    if plan.problem.parameters.terms:
        print_term_deviations(console, plan)
    if noisy := plan.noisy:
        logger.warning(
            "the assumed noise of efforts, %g %% of the effort limits, exceeds the planned efforts "
            "of %s; if these limits are placeholders, give the drives' own by --limits",
            plan.problem.sensors.effort_noise,
            ", ".join(noisy),
        )
    design = plan.problem.design
    lines = [
        f"{design.seconds:g} s, {counted(design.seconds / design.series.period, 'period')} of "
        f"{design.series.period:g} s, after {plan.approach:g} s from "
        f"{'the stance' if plan.contact_usage else 'any posture'} to the start",
        f"{plan.describe_determined()} expected to be determined",
        f"{plan.gain:.0f} bits of information to gain",
        *(f"assumed: {each}" for each in plan.problem.limits.assumed),
        *filter(None, [contacts_used(plan), closest_links(plan)]),
        *(f"not checked: {spelled(each, flag)}" for each in plan.problem.unchecked),
    ]
    files = [name for name in FILES if (out / name).exists()]
    for line in [*map(Text, lines), written_files(out, files)]:
        console.print(line, soft_wrap=True)


def print_usage(console: Console, plan: ExcitationPlan) -> None:
    """Print the share of each limit that each joint uses; mimic joints only follow others."""
    usage = plan.usage()
    rows = [
        (name, [f"{100 * shares[index]:.0f}" for shares in usage.values()])
        for index, name in plan.independent
    ]
    title = f"{plan.joints.model.name}: used of each limit, %"
    print_table(console, "joint", [list(usage)], rows, title=title)


def print_link_deviations(console: Console, plan: ExcitationPlan) -> None:
    """Print the expected deviations of the parameters of each link, SI units."""
    parameters = plan.problem.parameters
    cells = list(map(_deviation, plan.std.tolist(), plan.determined.tolist()))
    size = len(PARAMETERS)
    rows = [
        (link, cells[size * index : size * (index + 1)])
        for index, link in enumerate(parameters.link_names)
    ]
    title = (
        "expected standard deviations, SI units; in brackets: not determined (above "
        f"{100 * DETERMINED:.0f} % of that before)"
    )
    groups = PARAMETERS[:MOMENTS], PARAMETERS[MOMENTS:]
    print_table(console, "link", groups, rows, title=title)


def print_term_deviations(console: Console, plan: ExcitationPlan) -> None:
    """Print the expected deviation of each joint term."""
    parameters = plan.problem.parameters
    rows = []
    for place, joint in enumerate(parameters.joints.tolist()):
        columns = [columns.start + place for columns in parameters.term_columns.values()]
        cells = [_deviation(plan.std[column], plan.determined[column]) for column in columns]
        rows.append((parameters.model.joint_names[joint], cells))
    print_table(console, "joint", [list(parameters.term_columns)], rows)


def _deviation(std: float, determined: bool | np.bool_) -> Text:
    text = significant(std, 2)
    return Text(text) if determined else Text(f"({text})", style="dim")
