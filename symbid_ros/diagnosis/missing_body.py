"""Tells a body that the model lacks, such as a tool or payload, from wrong factors of efforts.

A body beyond a light wrist multiplies the load of its joints. The joints before these carry it too,
so that a factor of the wrist's efforts explains less than the body does.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.gain_problem import ITERATIONS, PINNED, GainEstimate, GainProblem
from symbid_ros.model.parameters import ParameterSet

# Prior deviation of the inertia of a body: that of the robot's mass within this radius, m.
RADIUS = 0.3
# Residuals below this share of the floor of the problem are noise.
NEGLIGIBLE = 0.1
# Largest geometric mean over joints of the residuals, as a share of those that factors of all
# efforts leave. It is .5 to .7 for payloads of 1 to 2 kg on simulated arms, and .98 or more for
# wrong factors.
BETTER = 0.8
# Up to this ratio, a body explains the efforts as well as factors do.
AS_WELL = 1.1
# Figure of a finding of wrong factors: the mass of such a body, kg.
EXPLAINED_AS_WELL = "or_body_kg"


def with_missing_body(
    findings: Sequence[Finding],
    joints: Sequence[str],
    problem: GainProblem,
    gains: GainEstimate,
    parameters: ParameterSet,
) -> tuple[Finding, ...]:
    """Return findings of wrong factors, or that of a body at a link if it explains more.

    If such a body explains the efforts as well as factors do, the last finding says so.

    Parameters
    ----------
    findings : sequence of Finding
    joints : sequence of str
        Joints whose efforts seem to have wrong factors. The body is beyond all of them.
    problem : GainProblem
    gains : GainEstimate
        Estimate with factors of all efforts, from the same rows.
    parameters : ParameterSet
        Columns of the problem.
    """
    model = parameters.model
    wrong = [model.joint_names.index(name) for name in joints]
    small = NEGLIGIBLE**2 * problem.floor
    found = {}
    for place, link in enumerate(parameters.links.tolist()):
        if wrong and model.ancestors[wrong, link].all():
            mass, left = _with_body(problem, place)
            ratio = np.exp(0.5 * np.mean(np.log((left + small) / (gains.left + small))))
            if mass > 0 and ratio < AS_WELL:
                found[model.link_names[link]] = float(ratio), mass
    if not found:
        return tuple(findings)
    link = min(found, key=lambda name: found[name][0])
    ratio, mass = found[link]
    body = f"a body of about {mass:.2g} kg at {link} that the model lacks explains the efforts"
    if ratio >= BETTER:
        last = findings[-1]
        message = f"{last.message}; {body} as well: if there is a tool, add it to the model instead"
        figures = {**last.figures, EXPLAINED_AS_WELL: mass}
        return (*findings[:-1], replace(last, message=message, figures=figures))
    topic = findings[0].stream
    text = (
        f"{topic}: {body}, of which those of {', '.join(joints)} seem to have wrong factors "
        "without it; add the tool or payload to the model"
    )
    return (Finding(Kind.MISSING_BODY, topic, Severity.WARNING, text, {"mass_kg": mass}),)


def _with_body(problem: GainProblem, place: int) -> tuple[float, FloatArray]:
    """Return the mass that a free body adds to a link, kg, and the mean square residuals (n,)."""
    columns = slice(10 * place, 10 * place + 10)
    mass = float(np.sum(problem.mean[: problem.number_of_inertias : 10]))
    std = problem.std.copy()
    std[columns] = mass * np.repeat([1.0, RADIUS, RADIUS**2], [1, 3, 6])
    free = replace(problem, std=std)
    pinned, left = np.full(len(problem.gains), PINNED), free.rows.target_squares
    for _ in range(2 * ITERATIONS):
        at, _ = free.solve(pinned, left + free.floor)
        left = free.rows.residual_squares(at)
    return float(at[columns.start] - problem.mean[columns.start]), left
