"""Joints that do not move in a log, whose readings may be frozen, and statistics of efforts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

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


@dataclass(frozen=True)
class EffortStatistics:
    """Statistics of the J joints' measured efforts.

    Attributes
    ----------
    size, change, noise : (J,) float64
        Root mean squares of the effort, of its deviation from the mean, and of its noise, Nm (N).
    correlation : (J,) float64
        Of effort and velocity.
    rate : float
        Hz.
    """

    size: FloatArray
    change: FloatArray
    noise: FloatArray
    correlation: FloatArray
    rate: float

    @classmethod
    def of(cls, segments: Iterable[Segment], model: RobotModel) -> "EffortStatistics":
        """Return the statistics of a log."""
        total, square, power, motion, bend = np.zeros((5, len(model.joints)))
        rate, count = 0.0, 0
        for segment in segments:
            effort = np.nan_to_num(segment.effort)
            velocity = np.gradient(segment.position, axis=0) * segment.rate
            total += effort.sum(axis=0)
            square += np.sum(effort**2, axis=0)
            motion += np.sum(velocity**2, axis=0)
            power += np.sum(effort * velocity, axis=0)
            # White noise of variance σ² has second differences of variance 6 σ².
            bend += np.sum(np.diff(effort, n=2, axis=0) ** 2, axis=0) / 6
            rate = segment.rate
            count += len(effort)
        count = max(count, 1)
        change = np.sqrt(np.maximum(square / count - (total / count) ** 2, 0.0))
        correlation = power / np.maximum(np.sqrt(square * motion), 1e-300)
        return cls(np.sqrt(square / count), change, np.sqrt(bend / count), correlation, rate)

    def averaged_noise(self, window: float) -> FloatArray:
        """Return the RMS noise (J,) of efforts that are averaged over windows of length in s."""
        return np.asarray(self.noise / np.sqrt(max(self.rate * window, 1.0)))


def unpredicted_at_rest(
    solved: SolvedProblem, dataset: Dataset, residual: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the joints of a fixed base that do not move and whose efforts are not predicted.

    ``residual`` is the RMS residual of each coordinate, Nm or N.
    """
    problem, rows = solved.problem, solved.chosen
    model = problem.parameters.model
    if model.floating:
        return ()
    is_resting = motionless_joints(dataset.samples.position, model)
    if not is_resting.any():
        return ()
    efforts = EffortStatistics.of(dataset.segments, model)
    noise = efforts.averaged_noise(rows.window)
    least = np.max([SHARE * efforts.size, SHARE_OF_CHANGE * efforts.change, CLEAR * noise], axis=0)
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
