"""The page of a fleet: robots that differ, common parameters, and the spread between robots."""

import numpy as np

from symbid_ros.estimation.fleet import FleetEstimate
from symbid_ros.identification.fleet import describe_deviation, fleet_verdict
from symbid_ros.report.formatting import significant
from symbid_ros.report.templates import page_template, shared_css


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
                (names[column], significant(change, 3), significant(std, 2), units[column])
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
            significant(float(found.common[i]), 4),
            significant(float(found.common_std[i]), 2),
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
        links=fleet_rows(found),
        spread=[(name, f"{100 * size:.2g}") for name, size in found.spread.items()],
        deviations=deviations,
        parameters=parameters,
        tests=found.tests,
    )


def fleet_rows(found: FleetEstimate) -> list[list[str]]:
    """Return a row for each link: mass, deviations, and how much heavier it is in each robot."""
    single = np.median(found.single_stds, axis=0)
    rows = []
    for index, link in enumerate(found.parameters.link_names):
        i = 10 * index
        mass = float(found.common[i])
        changes = [
            f"{100 * (value / mass - 1):+.1f} %".replace("-", "−") if mass else ""
            for value in found.values[:, i]
        ]
        rows.append(
            [
                link,
                f"{mass:.3f}",
                f"{found.common_std[i]:.3f}",
                f"{single[i]:.3f}",
                *changes,
            ]
        )
    return rows
