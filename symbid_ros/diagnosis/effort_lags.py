"""Rows with the efforts of other instants, from which a delay of any size follows.

Columns of derivatives hold for small delays only: Coulomb friction jumps where a joint reverses.
The delay is therefore found in steps, each from the rows with the efforts shifted by the last one.
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sensor_samples import SensorSamples

STEP = 0.01  # s between lags
LAGS = STEP * np.array([*range(-8, 0), *range(1, 9)])  # (L,) s


def lagged_efforts(layout: GainLayout, model: RobotModel, readings: SensorSamples) -> FloatArray:
    """Return (N, n, L) by how much the efforts differ from those that are read a lag later."""
    columns = np.zeros((len(readings), model.dof, len(LAGS)))
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    for place in layout.driven:
        effort = np.nan_to_num(readings.effort[:, place])
        for index, lag in enumerate(LAGS):
            later = np.interp(time + lag, time, effort)
            columns[:, 6 * model.floating + place, index] = later - effort
    return columns


@dataclass
class LaggedRows:
    """Rows in p + r unknowns, and in the shares of L lags by which the efforts are shifted.

    Attributes
    ----------
    rows : CoordinateRows
        The columns of the lags come last.
    delay : int
        The unknown that is the delay of the efforts.
    """

    rows: CoordinateRows
    delay: int

    @property
    def unshifted(self) -> CoordinateRows:
        """The rows in p + r unknowns, as they were read."""
        return self.rows.combined(np.eye(self.rows.structure.shape[1])[:, : -len(LAGS)])

    def shifted(self, delay: float) -> CoordinateRows:
        """Return the rows after the efforts are read so much later, s; lags limit the shift."""
        q = self.rows.structure.shape[1]
        late, slope = _interpolation(delay)
        shift = np.zeros(q)
        shift[-len(LAGS) :] = late
        change = np.eye(q)[:, : -len(LAGS)]
        change[self.delay, self.delay] = 0.0
        change[-len(LAGS) :, self.delay] = slope
        return self.rows.combined(change, shift)

    def shifted_factor(self, coordinate: int, delay: float) -> FloatArray:
        """Return the factor (w, p + r + 1) of one coordinate's rows [K y] after such a shift."""
        factor = self.rows.factor(coordinate)
        lags = np.arange(factor.shape[1] - 1 - len(LAGS), factor.shape[1] - 1)
        late, slope = _interpolation(delay)
        factor[:, -1] -= factor[:, lags] @ late
        factor[:, self.delay] = factor[:, lags] @ slope
        return np.delete(factor, lags, axis=1)


def _interpolation(delay: float) -> tuple[FloatArray, FloatArray]:
    """Return the shares (L,) of the lags at a delay, and their derivative; lags limit the delay."""
    largest = LAGS[-1] - STEP
    at = float(np.clip(delay, -largest, largest))
    return _shares(at), (_shares(at + STEP) - _shares(at - STEP)) / (2 * STEP)


def _shares(delay: float) -> FloatArray:
    """Return the shares (L,) of the lags that interpolate a delay linearly."""
    return np.maximum(1 - np.abs(LAGS - delay) / STEP, 0.0)
