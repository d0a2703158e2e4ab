"""Joints that do not move in a log: their readings cannot show springs, and may be frozen."""

from collections.abc import Mapping, Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.tree import RobotModel

# RMS deviation from the mean position of a joint that rests: rad, and m of a slide.
RESTING_ANGLE, RESTING_TRAVEL = 1e-3, 1e-4
# Shares of the RMS effort and of its RMS change above which the residual of such a joint is not
# what friction at rest leaves; fewest rows, and least residual in deviations of averaged noise.
SHARE, SHARE_OF_CHANGE, FEWEST_ROWS, CLEAR = 0.2, 0.5, 20, 3.0


def motionless_joints(position: FloatArray, model: RobotModel) -> BoolArray:
    """Return which of the J joints do not move in a log, from positions (N, J) at few instants."""
    if not len(position):
        return np.zeros(len(model.joints), dtype=bool)
    deviation = (position - position[0]).std(axis=0)  # of small numbers, whose squares are exact
    is_slide = np.array([joint.kind == "prismatic" for joint in model.joints])
    return np.asarray(deviation < np.where(is_slide, RESTING_TRAVEL, RESTING_ANGLE))


def unpredicted_at_rest(
    solved: SolvedProblem, dataset: Dataset, residual: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the joints of a fixed base that do not move and whose efforts are not predicted.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log.
    dataset : Dataset
        The log.
    residual : mapping of str to float
        RMS residual of each coordinate, Nm or N.
    """
    problem, rows = solved.problem, solved.chosen
    model = problem.parameters.model
    if model.floating:
        return ()
    is_resting = motionless_joints(dataset.samples.position, model)
    if not is_resting.any():
        return ()
    count, total, square, bend, rate = 0, *np.zeros((3, len(model.joints))), 0.0
    for segment in dataset.segments:
        effort = np.nan_to_num(segment.effort)
        count += len(effort)
        total += effort.sum(axis=0)
        square += np.sum(effort**2, axis=0)
        # White noise of variance σ² has second differences of variance 6 σ².
        bend += np.sum(np.diff(effort, n=2, axis=0) ** 2, axis=0) / 6
        rate = segment.rate
    size = np.sqrt(square / count)
    change = np.sqrt(np.maximum(square / count - (total / count) ** 2, 0.0))
    noise = np.sqrt(bend / count / max(rate * rows.window, 1.0))
    least = np.max([SHARE * size, SHARE_OF_CHANGE * change, CLEAR * noise], axis=0)
    counts = dict(zip(rows.layout.coordinates, rows.counts.diagonal(), strict=True))
    return tuple(
        name
        for name, rests, bound in zip(model.joint_names, is_resting, least, strict=True)
        if rests
        # Efforts whose factor is identified are not measured in Nm.
        and f"{name}/drive_gain" not in problem.sensor_names
        and counts.get(name, 0.0) >= FEWEST_ROWS
        and residual.get(name, 0.0) > bound
    )


def resting_alarm(names: Sequence[str]) -> str:
    """Return the alarm about joints that :func:`unpredicted_at_rest` found."""
    one = len(names) == 1
    return (
        f"{', '.join(names)} {'does' if one else 'do'} {Alarm.RESTING_JOINT} of "
        f"{'this joint' if one else 'these joints'} is not predicted: check whether "
        f"{'its encoder is' if one else 'their encoders are'} frozen, or "
        f"{'its brake' if one else 'their brakes'} closed"
    )
