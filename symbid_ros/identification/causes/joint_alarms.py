"""Alarms about joints whose efforts the estimate does not predict, or whose signs are wrong."""

import numpy as np

from symbid_ros.diagnosis.findings import OF_READINGS, Kind
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.unexplained import force_text
from symbid_ros.identification.causes.likely_cause import (
    FROZEN,
    MISSING_INERTIA,
    WRONG_READINGS,
    explained,
)
from symbid_ros.identification.conventions.joint_readings import find_readings
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.terms.resting_joints import (
    EffortStatistics,
    motionless_joints,
    resting_alarm,
    unpredicted_at_rest,
)

# Share of a joint's measured effort (RMS) above which its residual counts as all of it, fewest
# rows, and largest share of noise in averaged efforts.
ALL, FEWEST_ROWS, NOISE = 0.9, 20, 0.1
# The same share for a joint whose friction could not be judged, which may be what is missing.
MUCH = 0.3
# Correlation of effort and velocity below which the effort opposes the motion.
OPPOSED = -0.3
# What to check of a robot with one joint, and of one with several.
CHECK_DRIVER = (
    "check what the driver publishes as its effort",
    "check which joint the driver means by its position and its effort",
)
FOLLOWS = "; the other alarms may follow from this"


def with_explained_alarms(
    problem: LoadedProblem, found: Identification, *, has_known_units: bool
) -> Identification:
    """Return an identification with alarms about single joints, and likely causes of all alarms.

    Alarms about joints are those of a fixed base that move and whose effort is not predicted at
    all, and those at rest whose effort is not predicted. If there is any alarm, the log is searched
    for joints that it exchanges or reverses. If there are any, that alarm comes first. Because
    their readings would distort other causes, none is tried, and findings of the checks that
    depend on the readings are left out. If efforts lack their signs, alarms about the residuals
    would only repeat that. ``has_known_units`` says whether the user gave all efforts in the
    model's units; factors that the log itself shows do not excuse wrong signs.
    """
    if found.estimate.verdict is None:
        return found
    model, dataset = problem.parameters.model, problem.dataset
    resting = unpredicted_at_rest(problem.solved, dataset, found.estimate.residual_rmse)
    if model.floating:  # noise of wrenches adds to that of efforts
        return explained(problem, found, FROZEN if resting else "")
    if problem.checks.has_unsigned_efforts:
        return found.with_alarms(problem.checks.alarms)
    named = set[str]()
    unpredicted, unjudged = _unpredicted(problem, found)
    readings = None
    if (found.alarms or unpredicted or resting) and has_known_units:
        readings = find_readings(tuple(dataset.segments), model)
    lacks_inertia = any(one.kind is Kind.MISSING_INERTIA for one in problem.checks.findings)
    cause = MISSING_INERTIA if lacks_inertia else FROZEN if resting else ""
    cause = WRONG_READINGS if readings is not None else cause
    found = explained(problem, found, cause)
    alarms = sorted(found.alarms, key=lambda one: Alarm.MISSING_INERTIA not in one)
    if lacks_inertia and len(alarms) > 1:
        alarms[0] += FOLLOWS
    if readings is not None:
        depends = {one.message for one in problem.checks.findings if one.kind in OF_READINGS}
        alarms = [one for one in alarms if one not in depends]
        alarms.insert(0, readings.alarm + (FOLLOWS if alarms else ""))
        named = {
            *readings.exchanged,
            *readings.exchanged_positions,
            *readings.exchanged_efforts,
            *readings.reversed_joints,
            *readings.reversed_efforts,
        }
    if at_rest := [name for name in resting if name not in named]:
        alarms.append(resting_alarm(at_rest))
    alarms += [alarm for name, alarm in unpredicted.items() if name not in named]
    if missing := [one for name, one in unjudged.items() if name not in named]:
        alarms.append(
            f"{Alarm.UNJUDGED_FRICTION} {', '.join(missing)}: record longer, with more motion"
        )
    return found.with_alarms(tuple(alarms))


def _unpredicted(
    problem: LoadedProblem, found: Identification
) -> tuple[dict[str, str], dict[str, str]]:
    """Return an alarm for each joint whose effort is not predicted.

    Of joints whose friction could not be judged, the second dictionary has the sizes of what is not
    predicted.
    """
    solved, model = problem.solved, problem.parameters.model
    rows, choice, sensors = solved.chosen, solved.problem.choice, solved.problem.sensor_names
    counts = rows.counts.diagonal()
    measured = np.sqrt(rows.rows.target_squares / np.maximum(counts, 1))
    left = found.estimate.residual_rmse
    # Efforts whose factor is identified are not measured in Nm.
    joints = {one for one in model.joint_names if f"{one}/drive_gain" not in sensors}
    short = () if choice is None else choice.unjudged
    doubted = {
        name: size
        for name, size, count in zip(rows.layout.coordinates, measured, counts, strict=True)
        if name in joints
        and (name in short or count >= FEWEST_ROWS)
        and left.get(name, 0.0) > (MUCH if name in short else ALL) * size > 0.0
    }
    if not doubted:
        return {}, {}
    efforts = EffortStatistics.of(problem.dataset.segments, model)
    noise = efforts.averaged_noise(rows.window)
    is_resting = motionless_joints(problem.dataset.samples.position, model)
    alarms, unjudged = {}, {}
    for name, size in doubted.items():
        index = model.joint_names.index(name)
        if is_resting[index] or noise[index] > NOISE * size:
            continue
        unit = "Nm" if model.joints[index].kind == "revolute" else "N"
        if name in short:
            both = f"{force_text(left[name], unit)} of {force_text(size, unit)}"
            unjudged[name] = f"{name} ({both} unexplained)"
            continue
        cause = (
            "the effort opposes the motion, so the sign of one of them is wrong; give `flip_joint` "
            f"{name}, or `effort_scale` {name}:=-1"
            if efforts.correlation[index] < OPPOSED
            else CHECK_DRIVER[len(model.measured_joint_names) > 1]
        )
        alarms[name] = (
            f"{Alarm.UNPREDICTED_EFFORT} {name} ({force_text(size, unit)}), although the joint "
            f"moves and the effort is not noise: {cause}"
        )
    return alarms, unjudged
