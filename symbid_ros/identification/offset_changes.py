"""Wrist sensors whose offset in a log differs from that of the identified log."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.identification.predictions.force_errors import LEAST_COVERAGE, ForceRows
from symbid_ros.identification.predictions.intervals import HALF_WIDTH

# Mean squared error, in predicted variances, above which an offset counts as another one. The
# errors of a sensor with the same offset have 1 to 1.4.
CHANGED = 100.0
# Share by which the payload's weight must vary in the sensor's axes. Another payload, whose mean
# weight looked like an offset of 10 standard deviations, then leaves errors of 2 standard
# deviations, of which 36 % lie in their 90 % interval.
VARIED = 0.2


@dataclass(frozen=True)
class OffsetChange:
    """The offset of a wrist sensor, which another tare has changed.

    Attributes
    ----------
    frame : str
        The sensor.
    moment, force : (3,) float64
        By what its readings changed, Nm and N.
    """

    frame: str
    moment: FloatArray
    force: FloatArray

    def __str__(self) -> str:
        force, moment = (", ".join(f"{x:.3g}" for x in one) for one in (self.force, self.moment))
        return f"the offset of {self.frame} differs by {force} N; {moment} Nm"


def offset_changes(rows: ForceRows) -> tuple[OffsetChange, ...]:
    """Return the changes that explain all errors of a wrist sensor in a log."""
    found = []
    for frame, joints in rows.model.wrist_sensors.items():
        places = rows.first_joint + np.arange(joints.start, joints.stop)
        used = rows.valid[:, places].all(axis=1)
        variance = rows.variance[used][:, places]
        if len(variance) < 2 or not np.all(variance > 0):  # also if they are unknown
            continue
        error, std = rows.error_after[used][:, places], np.sqrt(variance)
        mean = error.mean(axis=0)
        is_inside = np.abs(error - mean) <= HALF_WIDTH * std
        if (
            np.mean((error / std) ** 2) > CHANGED
            and np.all(is_inside.mean(axis=0) >= LEAST_COVERAGE)
            and _varies(rows.gravity[used][:, places[3:]])
        ):
            # A row contains the negative reading.
            found.append(OffsetChange(frame, -mean[:3], -mean[3:]))
    return tuple(found)


def without_offset_changes(rows: ForceRows, changes: Iterable[OffsetChange]) -> ForceRows:
    """Return rows as of sensors with the offset of the identified log."""
    y, effort = rows.y.copy(), rows.effort.copy()
    for change in changes:
        joints = rows.model.wrist_sensors[change.frame]
        places = slice(rows.first_joint + joints.start, rows.first_joint + joints.stop)
        shift = np.concatenate([change.moment, change.force])
        y[:, places] += shift
        effort[:, places] += shift
    return replace(rows, y=y, effort=effort)


def _varies(weight: FloatArray) -> bool:
    """Return whether a force (N, 3) turns."""
    size = np.sqrt(np.mean(np.sum(weight**2, axis=1)))
    change = np.sqrt(np.mean(np.sum((weight - weight.mean(axis=0)) ** 2, axis=1)))
    return bool(change > VARIED * size)
