"""Files of a designed trajectory: CSV, bag, goal of a ros2_control controller, and the plan."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import staged, write_text
from symbid_ros.bags import BagWriter
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.excitation.page import render_page
from symbid_ros.excitation.plan import ExcitationPlan
from symbid_ros.excitation.rehearsal import PLAN_FILE
from symbid_ros.excitation.standing_motion import StandingMotion
from symbid_ros.json_documents import versioned
from symbid_ros.messages.types import TRAJECTORY, trajectory_message
from symbid_ros.package_paths import package_version
from symbid_ros.simulation.joint_trajectory import (
    ACCELERATION,
    EFFORT,
    POSITION,
    TIME,
    TRAJECTORY_FILE,
    VELOCITY,
)

PAGE, PRIOR_FILE = "plan.html", "prior.json"
BAG, GOAL_FILE = "trajectory_bag", "goal.yaml"
VALIDATION_FILE, VALIDATION_BAG = "validation.csv", "validation_bag"
FILES = (
    TRAJECTORY_FILE,
    PLAN_FILE,
    PAGE,
    PRIOR_FILE,
    GOAL_FILE,
    BAG,
    VALIDATION_FILE,
    VALIDATION_BAG,
)
# Where ros2_control's joint_trajectory_controller listens.
TOPIC = "/joint_trajectory_controller/joint_trajectory"
CSV_RATE = 100.0  # Hz
# Points of the message for each period of the fastest harmonic. Controllers interpolate positions,
# velocities and accelerations by quintics, whose error is then below a microradian.
POINTS_PER_WAVE = 16
DIGITS, GOAL_DIGITS = 9, 7


def write_plan(plan: ExcitationPlan, out: Path) -> None:
    """Write all files of a plan into a folder, together.

    Raises
    ------
    SymbidError
        When the folder cannot be written to.
    """
    with staged(out) as stage:
        write_text(stage / TRAJECTORY_FILE, csv_text(plan))
        write_text(stage / GOAL_FILE, goal_text(plan))
        write_text(stage / PLAN_FILE, json.dumps(document(plan), indent=1) + "\n")
        write_text(stage / PAGE, render_page(plan))
        if plan.problem.prior is not None:
            write_prior(stage / PRIOR_FILE, plan.problem.prior)
        _write_bag(plan, stage / BAG)
        other = replace(plan, coefficients=plan.validation)
        write_text(stage / VALIDATION_FILE, csv_text(other))
        _write_bag(other, stage / VALIDATION_BAG)
    if plan.problem.prior is None:  # that of an earlier plan would be taken for this one's
        (out / PRIOR_FILE).unlink(missing_ok=True)


def csv_text(plan: ExcitationPlan) -> str:
    """Return the trajectory as CSV: time, then position, velocity, acceleration and effort."""
    seconds = plan.problem.design.seconds
    time = np.arange(round(seconds * CSV_RATE) + 1) / CSV_RATE
    columns = np.concatenate([*plan.motion(time), plan.torque(time)], axis=1)
    kinds = (POSITION, VELOCITY, ACCELERATION, EFFORT)
    header = [TIME, *(f"{name}/{kind}" for kind in kinds for name in plan.joints.names)]
    if isinstance(plan.joints, StandingMotion):
        names, others = plan.joints.other_columns(plan.course(time))
        header, columns = [*header, *names], np.hstack([columns, others])
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for instant, row in zip(time.tolist(), columns.tolist(), strict=True):
        writer.writerow([f"{instant:.{DIGITS}g}", *(f"{value:.{DIGITS}g}" for value in row)])
    return stream.getvalue()


def _points(plan: ExcitationPlan) -> tuple[FloatArray, FloatArray]:
    """Return times (N,), s, and motion (3, N, D) of the message, after the approach."""
    design = plan.problem.design
    waves = design.series.harmonics * design.seconds / design.series.period
    time = np.linspace(0.0, design.seconds, round(POINTS_PER_WAVE * waves) + 1)
    return plan.approach + time, plan.motion(time)


def goal_text(plan: ExcitationPlan) -> str:
    """Return the goal of a FollowJointTrajectory action as YAML."""
    time, motion = _points(plan)
    points = []
    for instant, position, velocity, acceleration in zip(time.tolist(), *motion, strict=True):
        nanoseconds = round(instant * 1e9)
        points.append(
            {
                "positions": [round(value, GOAL_DIGITS) for value in position.tolist()],
                "velocities": [round(value, GOAL_DIGITS) for value in velocity.tolist()],
                "accelerations": [round(value, GOAL_DIGITS) for value in acceleration.tolist()],
                "time_from_start": {
                    "sec": nanoseconds // 10**9,
                    "nanosec": nanoseconds % 10**9,
                },
            }
        )
    goal = {"trajectory": {"joint_names": list(plan.joints.names), "points": points}}
    text: str = yaml.safe_dump(goal, default_flow_style=None, sort_keys=False, width=10_000)
    return text


def _write_bag(plan: ExcitationPlan, path: Path) -> None:
    time, motion = _points(plan)
    payload = trajectory_message(plan.joints.names, np.rint(time * 1e9).astype(np.int64), motion)
    with BagWriter(path) as bag:
        bag.write(bag.add_topic(TOPIC, TRAJECTORY), 0, payload)


def document(plan: ExcitationPlan) -> dict[str, object]:
    """Return the plan as JSON: coefficients, limits and the expected deviations of parameters."""
    problem = plan.problem
    design, limits = problem.design, problem.limits
    names = plan.joints.names
    usage = plan.usage()
    content = {
        "software": f"symbid_ros {package_version()}",
        "model": plan.joints.model.name,
        "model_file": plan.joints.model.source,
        "seconds": design.seconds,
        "period_s": design.series.period,
        "harmonics": design.series.harmonics,
        "approach_s": plan.approach,
        "is_complete": plan.is_complete,
        "gain_bits": plan.gain,
        "rate_hz": problem.sensors.rate,
        "effort_noise_percent": problem.sensors.effort_noise,
        "position_noise_rad": problem.sensors.position_noise,
        "coefficients": dict(
            zip(plan.joints.coordinates, plan.coefficients.T.tolist(), strict=True)
        ),
        "joints": {
            name: {
                "lower": float(limits.lower[index]),
                "upper": float(limits.upper[index]),
                "velocity": float(limits.speed[index]),
                "acceleration": float(limits.acceleration[index]),
                "effort": _finite(float(limits.effort[index])),
                "noise_effort": float(problem.capacity[place]),
                "used": {kind: float(shares[index]) for kind, shares in usage.items()},
            }
            for index, (name, place) in enumerate(zip(names, plan.joints.indices, strict=True))
        },
        "assumed": list(limits.assumed),
        "smallest_distance_m": _finite(plan.closest[0]) if plan.closest is not None else None,
        "closest_links": plan.closest[1] if plan.closest is not None else "",
        "unchecked": list(problem.unchecked),
        "feet": _feet(plan),
        "contacts_used": plan.contact_usage,
        "parameters": {
            name: {
                "unit": unit,
                "value": value,
                "std_before": before,
                "std_expected": after,
                "determined": determined,
            }
            for name, unit, value, before, after, determined in zip(
                problem.parameters.names,
                problem.parameters.units,
                design.expected.values.tolist(),
                problem.prior_std.tolist(),
                plan.std.tolist(),
                plan.determined.tolist(),
                strict=True,
            )
        },
    }
    return versioned("plan", content)


def _feet(plan: ExcitationPlan) -> dict[str, object]:
    """Return the feet on which the robot stands; none on a fixed base."""
    if not isinstance(plan.joints, StandingMotion):
        return {}
    contacts = plan.problem.parameters.model.contacts
    unmeasured = () if contacts is None else contacts.frames
    return {
        foot.frame: {
            "sole_m": foot.sole.tolist(),
            "radius_m": foot.radius,
            "has_sensor": foot.frame not in unmeasured,
        }
        for foot in plan.joints.stance.feet
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
