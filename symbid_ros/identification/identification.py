"""What an identification found: an estimate with the data for predictions and for later runs."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.archive import SensorCalibration
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.report_data import ReportData
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.signals.sampled_rows import RowBuilder


@dataclass(frozen=True)
class Identification:
    """An estimate with the data for predictions and for later runs.

    Attributes
    ----------
    estimate : Estimate
    observations : tuple of Observations
        The data for each window length.
    factor : (p + s, r) float64 or None
        L of the covariance L Lᵀ of all unknowns; None for truncated methods.
    window : float
        Window length of the rows that were solved, s; 0 for rows at single instants.
    unknowns : (p + s,) float64
        The parameters, then the sensor errors.
    rows : RowBuilder
        Builds the rows of these unknowns.
    scale_change : (p,) float64 or None
        Change of all parameters with one deviation of the gain that no residual shows. It scales a
        link's parameters alike where the data determine them, and then moves no centre of mass.
    correlation : (n, n) float64 or None
        Of the residuals of a row's coordinates, on a robot with unmeasured contacts.
    report : ReportData or None
        What a report shows of the log; None without a log.
    """

    estimate: Estimate
    observations: tuple[Observations, ...]
    factor: FloatArray | None
    window: float
    unknowns: FloatArray
    rows: RowBuilder
    scale_change: FloatArray | None = None
    correlation: FloatArray | None = None
    report: ReportData | None = None

    @property
    def deviation_factor(self) -> FloatArray | None:
        """(p, r) L of the robot's parameters' covariance L Lᵀ; None for truncated methods."""
        return None if self.factor is None else self.factor[: len(self.estimate.names)]

    @property
    def alarms(self) -> tuple[str, ...]:
        """Reasons not to trust the estimate, one line each; none without a verdict."""
        verdict = self.estimate.verdict
        return () if verdict is None else verdict.alarms

    def with_alarms(self, alarms: tuple[str, ...]) -> "Identification":
        """Return the same with these alarms alone, if its estimate has a verdict to hold them."""
        verdict = self.estimate.verdict
        if verdict is None:
            return self
        verdict = replace(verdict, alarms=alarms)
        return replace(self, estimate=replace(self.estimate, verdict=verdict))

    @property
    def calibration(self) -> SensorCalibration | None:
        """What predictions with sensor errors need; None without sensor errors."""
        if self.factor is None or not isinstance(self.rows, CalibratingRows):
            return None
        point = self.rows.linearization
        # Rows are linear in changes of sensor errors during the log.
        linearization = np.zeros(len(self.unknowns))
        linearization[: len(point.phi) + len(point.theta)] = np.r_[point.phi, point.theta]
        return SensorCalibration(self.factor[len(self.estimate.names) :], linearization)
