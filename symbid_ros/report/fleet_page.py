"""The page of a fleet: robots that differ, common parameters, and the spread between robots."""

import numpy as np

from symbid_ros.estimation.fleet import FleetEstimate
from symbid_ros.estimation.fleet_changes import MassChange
from symbid_ros.identification.fleet import (
    describe_deviation,
    detectable_changes,
    fleet_verdict,
    percent_with_std,
    spread_sizes,
)
from symbid_ros.report.formatting import ABSENT, significant, with_std
from symbid_ros.report.templates import page_template, shared_css

COLUMNS = "kg", "± kg", "one robot ± kg", "detectable"
LEGEND = (
    "Each robot's column is the change of the whole link against the other robots, with its "
    f"standard deviation. Detectable: the smallest change that would be named with 90 % "
    f"probability in any of the robots. {ABSENT}: not even a link of twice the mass would be named."
)


def render_fleet(found: FleetEstimate) -> str:
    """Return the page as HTML without scripts and external resources."""
    names, units = found.parameters.names, found.parameters.units
    single = np.median(found.single_stds, axis=0)
    deviations = [
        {
            "sentence": describe_deviation(one),
            "p_value": f"{one.p_value:.1g}",
            "evidence": f"{one.evidence:.0f}",
            "rows": [
                (names[column], with_std(change, std), units[column])
                for column, change, std in zip(
                    one.columns, one.change.tolist(), one.std.tolist(), strict=True
                )
            ],
        }
        for one in found.deviations
    ]
    parameters = [
        (
            name,
            with_std(float(found.common[i]), float(found.common_std[i])),
            significant(float(single[i]), 2),
            units[i],
        )
        for i, name in enumerate(names)
    ]
    return page_template("fleet.html").render(
        title=f"Fleet of {found.parameters.model.name}",
        css=shared_css(),
        model=found.parameters.model.name,
        verdict=fleet_verdict(found),
        robots=found.robots,
        links=[row[: len(COLUMNS) + 1] for row in fleet_rows(found)],
        columns=COLUMNS,
        changes=change_table(found),
        absent=ABSENT,
        spread=list(spread_sizes(found).items()),
        deviations=deviations,
        parameters=parameters,
        tests=found.tests,
    )


def fleet_rows(found: FleetEstimate) -> list[list[str]]:
    """Return a row for each link: common mass, detectable change, and each robot's change."""
    single = np.median(found.single_stds, axis=0)
    rows = []
    for index, (link, detectable) in enumerate(detectable_changes(found).items()):
        i = 10 * index
        rows.append(
            [
                link,
                f"{float(found.common[i]):.3f}",
                f"{found.common_std[i]:.3f}",
                f"{single[i]:.3f}",
                ABSENT if detectable is None else f"{100 * detectable:.2g} %",
                *(_change(robot[index]) for robot in found.link_changes),
            ]
        )
    return rows


def change_table(found: FleetEstimate) -> tuple[tuple[str, ...], list[tuple[str, list[str]]]]:
    """Return titles and rows of each robot's changes, with the fewer of links and robots across."""
    robots, links = found.robots, found.parameters.link_names
    cells = [[_change(one) for one in robot] for robot in found.link_changes]
    if len(links) < len(robots):
        return ("robot", *links), list(zip(robots, cells, strict=True))
    by_link = [list(one) for one in zip(*cells, strict=True)]
    return ("link", *robots), list(zip(links, by_link, strict=True))


def _change(one: MassChange | None) -> str:
    if one is None or not one.is_shown:
        return ABSENT
    return percent_with_std(one.relative, one.std, "+")
