"""How much a whole link of one robot differs from those of the others, and what would be seen."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2

from symbid_ros.arrays import FloatArray

LEVEL = 0.01  # chance of a false alarm in the whole fleet
# Relative deviation of a link that is denser or lighter than the others of the fleet.
DENSER = 0.25
POWER = 0.9  # probability with which a detectable change is named


@dataclass(frozen=True)
class MassChange:
    """Relative change of one robot's link whose mass is distributed as in the others.

    Attributes
    ----------
    relative, std : float
        The change, not reduced by the prior that robots are alike, and its standard deviation.
    detectable : float
        Smallest change that would be named with the probability ``POWER``, if it were the only one.
    """

    relative: float
    std: float
    detectable: float

    @property
    def is_shown(self) -> bool:
        """Whether a link of twice the mass would be named."""
        return self.detectable < 1


def link_change(
    score: FloatArray, information: FloatArray, denser: FloatArray, own: FloatArray, tests: int
) -> MassChange | None:
    """Return the change of a link; None if a typical change would not show.

    Parameters
    ----------
    score, information : (p,), (p, p) float64
        Of a deviation of the robot, and the score's covariance.
    denser : (p, 1) float64
        The change by ``DENSER``.
    own : (p, k) float64
        Factor of the covariance of the link's common parameters: the change is relative to them.
    tests : int
        Number of places and robots that are tested.
    """
    weight = float((denser.T @ information @ denser).item())
    if weight <= 1:
        return None
    relative = DENSER * float((denser.T @ score).item()) / weight
    effect = own.T @ information @ denser[:, 0] * DENSER / weight
    std = DENSER / np.sqrt(weight)
    doubt = abs(relative) * float(np.linalg.norm(effect))
    return MassChange(relative, float(np.hypot(std, doubt)), std * _least_score(weight, tests))


def _least_score(weight: float, tests: int) -> float:
    """Return the change in standard deviations that passes both tests with ``POWER``.

    These are Holm's first step, for either of two kinds of change, and the prior odds.
    """
    significant = float(np.sqrt(chi2.isf(LEVEL / tests / 2, 1)))
    evidence = np.log(tests / LEVEL) + np.log(2) + np.log1p(weight) / 2
    evident = float(np.sqrt(2 * (1 + weight) / weight * evidence))
    return max(significant, evident) + float(ndtri(POWER))
