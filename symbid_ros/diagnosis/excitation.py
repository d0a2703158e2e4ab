"""How much a log could tell of a robot of which the model is right to ±25 %."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.gains import loads
from symbid_ros.diagnosis.model_watch import ModelWatch
from symbid_ros.estimation.verdict import DETERMINED
from symbid_ros.signals.weak_form import INFLATION

# Share of a load that a good sensor cannot tell: what moves less is no motion, noise or none.
RESOLUTION = 5e-3
# So few directions beyond those of a single pose are next to nothing.
FEWEST = 3


@dataclass(frozen=True)
class Excitation:
    """What a log determines.

    Attributes
    ----------
    determined : int
        Directions of the parameters of which more than half the prior's variance goes.
    at_rest : int
        As many of them as the mean pose tells without any motion.
    gain : float
        Information over the prior, bit.
    """

    determined: int
    at_rest: int
    gain: float


def excitation(watch: ModelWatch, left: FloatArray) -> Excitation:
    """Judge rows of which (n,) variances are left when their gains are known."""
    rows_, prior = watch.rows, watch.prior
    p = len(prior.names)
    scale = loads(rows_, watch.problem.expected)
    deviation = np.sqrt(INFLATION * (left + (RESOLUTION * scale) ** 2))
    L = prior.covariance_factor()
    rows = rows_.whitened(deviation)[:, :p] @ L
    at_rest = np.sqrt(rows_.samples) * (watch.mean_row / deviation[:, None]) @ L
    singular = np.linalg.svd(rows, compute_uv=False)
    # Rows s and a prior of one leave a deviation of 1/√(1 + s²).
    least = np.sqrt(1 / DETERMINED**2 - 1)
    return Excitation(
        determined=int(np.sum(singular > least)),
        at_rest=int(np.sum(np.linalg.svd(at_rest, compute_uv=False) > least)),
        gain=float(np.sum(np.log2(1 + singular**2)) / 2),
    )
