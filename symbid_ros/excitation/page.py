"""The page of a plan: the motion, the limits that it keeps, and what it is expected to tell."""

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.excitation.plan import ExcitationPlan
from symbid_ros.report.formatting import significant
from symbid_ros.report.templates import page_template, shared_css

WIDTH, HEIGHT, LEFT, BOTTOM = 300, 170, 46, 16  # of a panel, px
POINTS = 300  # of a curve
KINDS = "position", "velocity", "acceleration", "effort"
GRID = (100, 50, 0, -50, -100)  # percent


def render_page(plan: ExcitationPlan) -> str:
    """Return the page as HTML without scripts and external resources."""
    design = plan.problem.design
    return page_template("plan.html", "symbid_ros.excitation").render(
        title=f"Plan for {plan.joints.model.name}",
        css=shared_css() + Path(__file__).with_name("plan.css").read_text(encoding="utf-8"),
        model=plan.joints.model.name,
        headline=headline(plan),
        seconds=design.seconds,
        period=design.series.period,
        width=WIDTH,
        height=HEIGHT,
        left=LEFT,
        grid=[{"y": _height(one / 100), "label": f"{one} %".replace("-", "−")} for one in GRID],
        kinds=KINDS,
        panels=_panels(plan),
        joints=plan.independent,
        usage=plan.usage(),
        closest=closest_links(plan),
        contacts=contacts_used(plan),
        groups=_groups(plan),
        notes=_notes(plan),
    )


def headline(plan: ExcitationPlan) -> str:
    """Return the plan's result in one sentence."""
    return (
        f"{plan.problem.design.seconds:g} s of this motion are expected to determine "
        f"{plan.describe_determined()} ({plan.gain:.0f} bits of information)."
    )


def closest_links(plan: ExcitationPlan) -> str:
    """Return the smallest distance between two links as a sentence; empty without shapes."""
    if plan.closest is None:
        return ""
    distance, pair = plan.closest
    if not pair:
        return "no links come close to each other"
    return f"smallest distance {1e3 * distance:.0f} mm, between {pair}"


def contacts_used(plan: ExcitationPlan) -> str:
    """Return the largest use of each limit of the contacts as a sentence; empty without feet."""
    used = plan.contact_usage
    listed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in used.items())
    return f"used of the limits of contacts: {listed}" if used else ""


def _height(share: float) -> float:
    return round((HEIGHT - BOTTOM) / 2 * (1 - 0.94 * share), 1)


def _panels(plan: ExcitationPlan) -> list[dict[str, Any]]:
    """Return the curves of each joint in shares of its limits, as paths of SVG."""
    limits, options = plan.problem.limits, plan.problem.options
    time = np.linspace(0, plan.problem.design.series.period, POINTS)
    motion, torque = plan.motion(time), plan.torque(time)
    kinds = {
        "position": (motion[0] - limits.centre) / limits.half_width,
        "velocity": motion[1] / limits.speed,
        "acceleration": motion[2] / limits.acceleration,
        "effort": torque / limits.effort,
    }
    speed = options.speed_share
    shares = dict(
        zip(KINDS, (options.position_share, speed, speed, options.effort_share), strict=True)
    )
    panels = []
    for index, name in enumerate(plan.joints.names):
        sides = (limits.lower[index], limits.upper[index])
        slides = plan.joints.model.joints[plan.joints.indices[index]].kind == "prismatic"
        low, high = sides if slides else np.degrees(sides)
        panels.append(
            {
                "joint": name,
                "curves": {kind: _path(values[:, index]) for kind, values in kinds.items()},
                "allowed": [
                    (kind, _height(sign * share))
                    for kind, share in shares.items()
                    for sign in (1, -1)
                ],
                "range": f"{low:.3g} to {high:.3g} {'m' if slides else '°'}, "
                f"{limits.speed[index]:.3g} {'m' if slides else 'rad'}/s, "
                f"{limits.acceleration[index]:.3g} {'m' if slides else 'rad'}/s², "
                f"{limits.effort[index]:.3g} {'N' if slides else 'Nm'}".replace("-", "−"),
            }
        )
    return panels


def _path(shares: FloatArray) -> str:
    places = np.linspace(LEFT, WIDTH - 2, len(shares))
    points = [f"{x:.1f} {_height(share):.1f}" for x, share in zip(places, shares, strict=True)]
    return f"M{'L'.join(points)}"


def _groups(plan: ExcitationPlan) -> list[dict[str, Any]]:
    """Return the rows of all parameters by link and joint."""
    problem = plan.problem
    rows = [
        {
            "owner": name.rpartition("/")[0],
            "name": name.rpartition("/")[2],
            "unit": unit,
            "value": significant(value).replace("-", "−"),
            "before": significant(before, 2).replace("-", "−"),
            "after": significant(after, 2).replace("-", "−"),
            "determined": bool(determined),
        }
        for name, unit, value, before, after, determined in zip(
            problem.parameters.names,
            problem.parameters.units,
            problem.design.expected.values.tolist(),
            problem.prior_std.tolist(),
            plan.std.tolist(),
            plan.determined,
            strict=True,
        )
    ]
    inertial = problem.parameters.inertial
    # Terms are listed by kind, and shown by joint.
    joints = dict.fromkeys(row["owner"] for row in rows[inertial:])
    ordered = rows[:inertial] + [
        row for joint in joints for row in rows[inertial:] if row["owner"] == joint
    ]
    groups = []
    for owner, some in groupby(ordered, key=lambda row: row["owner"]):
        members = list(some)
        known = sum(bool(row["determined"]) for row in members)
        groups.append({"name": owner, "rows": members, "determined": known, "is_open": False})
    next((group for group in groups if group["determined"]), groups[0])["is_open"] = True
    return groups


def _notes(plan: ExcitationPlan) -> list[str]:
    sensors, problem = plan.problem.sensors, plan.problem
    prior = "an earlier result"
    if problem.prior is not None:
        prior = f"the model's values ± {problem.options.prior_percent:g} %"
    return [
        f"Known before: {prior}.",
        f"Sensors: {sensors.rate:g} Hz; noise of efforts {sensors.effort_noise:g} % of each "
        f"joint's effort limit, and of positions {sensors.position_noise:g} rad.",
        f"The controller first moves to the start posture within {plan.approach:g} s. Nothing "
        "checks that move for collisions.",
        *(f"Assumed, because no file states it: {each}." for each in problem.limits.assumed),
        *(f"Not checked: {each.replace('`', '')}." for each in problem.unchecked),
    ]
