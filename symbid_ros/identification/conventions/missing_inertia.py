"""Efforts that show the gravity of a robot but not its inertia.

They are the commands of a gravity compensation, or those of a robot that is moved by hand. The
identification would then cancel the inertias of the links by negative armatures.

Gravity is half of the difference between the rows of the equation of motion with gravity and with
its opposite, and inertial forces are the rest. A fit of gravity and friction alone is compared with
one that also has half of the inertial forces of point masses at the links' centres of mass. Bodies
of any shape that have this gravity have at least the inertia of these points, and drives add to it.
Errors of the model's masses, units of efforts and currents matter little, because the inertial
forces are multiplied by the ratio of the fitted gravity to the model's.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.conventions.loose_fit import loose_rows, some_blocks
from symbid_ros.model.inertia import com_from_phi, phi_from_com
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

# Share of the inertial forces of point masses that efforts have at least. It is 0.5 and not 1
# because the model's masses may be wrong.
LEAST_INERTIA = 0.5
# Gravity of a joint is judged if that of the model varies by this share of the effort (RMS).
LEAST_GRAVITY = 0.1
# Gravity and friction have to leave less than this share of the effort, and with the least inertia
# the rest has to be so many times as large.
MOST_LEFT, MULTIPLIED = 0.1, 2.0
# It also has to be less likely by this many nats.
EVIDENCE = 50.0


def find_missing_inertia(segments: Iterable[Segment], robot: RobotModel) -> tuple[str, ...]:
    """Return the joints whose efforts have gravity but no inertia; none if the log is too slow.

    Only a robot with a fixed base and without unmeasured contacts is judged.
    """
    if robot.floating or robot.contacts is not None:
        return ()
    blocks = list(some_blocks(segments))
    rows = loose_rows(blocks, robot)
    opposite = loose_rows(blocks, replace(robot, gravity=-robot.gravity))
    if rows is None or opposite is None:
        return ()
    parameters, links = rows.parameters, slice(0, rows.parameters.inertial)
    inertial_part = (rows.K[..., links] + opposite.K[..., links]) / 2
    K = rows.K.copy()
    K[..., links] -= inertial_part
    K[..., parameters.term_columns["armature"]] = 0.0
    weight = replace(rows, K=K)
    fit = weight.fit()
    count = np.maximum(rows.valid.sum(axis=0), 1)

    def varying(theta: FloatArray) -> FloatArray:
        """Return the gravity (N, n) of links without its mean, which a constant torque replaces."""
        force = np.where(rows.valid, K[..., links] @ theta[links], 0.0)
        return np.where(rows.valid, force - force.sum(axis=0) / count, 0.0)

    of_model = varying(rows.mean)
    square = np.sum(of_model**2, axis=0)
    scale = np.sum(of_model * varying(fit.theta), axis=0) / np.maximum(square, 1e-300)
    size = np.sqrt(square / count)
    is_heavy = (size > LEAST_GRAVITY * rows.read) & (scale > 0)
    bodies = map(com_from_phi, parameters.link_phi(rows.mean))
    points = np.concatenate([phi_from_com(mass, com, np.zeros((3, 3))) for mass, com, _ in bodies])
    force = np.where(is_heavy, scale * (inertial_part @ points), 0.0)
    moved = replace(weight, y=rows.y - LEAST_INERTIA * force)
    other = moved.fit()
    if other.cost < fit.cost + EVIDENCE:
        return ()
    left, more = fit.shares * weight.read, other.shares * moved.read
    lacks = is_heavy & (left < MOST_LEFT * rows.read) & (more > MULTIPLIED * left)
    return tuple(
        name
        for name, is_lacking in zip(robot.joint_names, lacks, strict=True)
        if is_lacking and name in robot.measured_joint_names
    )


def missing_inertia_finding(topic: str, joints: Sequence[str]) -> Finding:
    """Return the finding that the efforts of joints have gravity but no inertia."""
    return Finding.of(
        topic,
        Kind.MISSING_INERTIA,
        f"the efforts of {', '.join(joints)} {Alarm.MISSING_INERTIA}: either the robot was moved "
        "by hand, or the efforts are commands of a gravity compensation; record measured efforts "
        "of a motion that the drives perform",
        {"joints": len(joints)},
        Severity.WARNING,
    )
