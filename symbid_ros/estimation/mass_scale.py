"""The scale of all masses: a weighing against the data, and the gain that only a weighing shows.

A gain g that all efforts and wrenches have in common scales every inertial parameter and friction,
K φ = (1 + g) y, and leaves no residual. The data cannot contradict it: only the prior and a
weighing can.
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements

# Usual deviation of the gain that sensors calibrated in one laboratory have in common.
FORCE_SCALE_STD = 0.01
# A weighing does not check the gain if it leaves this share of its deviation.
UNCHECKED = 0.7
# A weighing contradicts the data beyond this many standard deviations,
DEVIATIONS = 4.0
# and this share of the mass: gravity differs by 0.3 % on Earth, and so does what a scale reads.
LEAST_DIFFERENCE = 0.005


@dataclass(frozen=True)
class WeighingResidual:
    """A weighing against the mass that the data alone imply.

    Attributes
    ----------
    weighed, weighed_std : float
        The weighing, kg.
    implied, implied_std : float
        Mass of the robot by data and prior without the weighing, kg.
    """

    weighed: float
    weighed_std: float
    implied: float
    implied_std: float

    @property
    def deviations(self) -> float:
        """Difference in standard deviations."""
        spread = np.hypot(self.weighed_std, self.implied_std)
        return float((self.weighed - self.implied) / spread)

    @property
    def is_contradiction(self) -> bool:
        """Whether the difference is more than chance and local gravity explain."""
        least = LEAST_DIFFERENCE * abs(self.weighed)
        return abs(self.deviations) > DEVIATIONS and abs(self.weighed - self.implied) > least


def weighing_residual(
    posterior: Posterior, measurements: PseudoMeasurements | None
) -> WeighingResidual | None:
    """Return the weighing against the data; None without a weighing.

    The posterior contains the weighing. Its residual r and leverage h give the prediction without
    it, t - r / (1 - h), in closed form (Cook and Weisberg 1982, Residuals and Influence in
    Regression, section 2.2).
    """
    if measurements is None or not measurements.has_weighing:
        return None
    row, target = measurements.rows[0], float(measurements.targets[0])
    std = measurements.weighing_std
    felt = posterior.independent_factor.T @ row
    # The leverage is close to one if only the weighing knows the mass.
    leverage = min(float(felt @ felt), 1 - 1e-9)
    residual = (target - float(row @ posterior.mean)) / (1 - leverage)
    variance = leverage / (1 - leverage)
    if posterior.excess_score is not None:
        excess = (posterior.independent_factor @ felt) @ posterior.excess_score
        variance += float(excess @ excess) / (1 - leverage) ** 2
    return WeighingResidual(
        weighed=std * target,
        weighed_std=std,
        implied=std * (target - residual),
        implied_std=std * float(np.sqrt(variance)),
    )


@dataclass(frozen=True)
class CommonGain:
    """The gain that all efforts and wrenches have in common.

    Attributes
    ----------
    std : float
        Its standard deviation, with all that is known.
    direction : (p,) float64
        Change of the estimate with this gain.
    """

    std: float
    direction: FloatArray


def common_gain(
    posterior: Posterior,
    value: FloatArray,
    measurements: PseudoMeasurements | None,
    std: float,
    is_anchor: BoolArray,
) -> CommonGain:
    """Return what is known about the common gain of efforts and wrenches.

    Parameters
    ----------
    posterior : Posterior
    value : (p,) float64
        The estimate.
    measurements : PseudoMeasurements or None
        Weighing and symmetry.
    std : float
        Deviation of the gain by the sensors' calibration.
    is_anchor : (p,) bool
        Unknowns whose prior does not scale with the sensors: not joint terms.

    Notes
    -----
    With the precision A of prior and pseudo-measurements and the posterior covariance Σ, the
    estimate changes by u = φ - Σ A φ per unit of gain. Data and prior together give the gain the
    precision uᵀ A φ, in addition to 1/std².
    """
    anchored = np.where(is_anchor, value, 0.0)
    L = posterior.prior.covariance_factor()
    moment = np.linalg.solve(L.T, np.linalg.solve(L, anchored))
    moment = np.where(is_anchor, moment, 0.0)
    if measurements is not None:
        moment += measurements.rows.T @ (measurements.rows @ anchored)
    factor = posterior.independent_factor
    direction = value - factor @ (factor.T @ moment)
    precision = 1 / std**2 + max(float(direction @ moment), 0.0)
    return CommonGain(float(1 / np.sqrt(precision)), direction)
