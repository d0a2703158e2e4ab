"""Whether sensor errors drift during a log, and how much: by the evidence of the data."""

from itertools import product

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.sandwich import correlation_factors
from symbid_ros.signals.sensor_drift import DRIFTING_KINDS, SensorDrift
from symbid_ros.signals.sensor_errors import SensorErrors

# Changes in a minute, as factors on the errors' usual deviations: 0.06 to 2 N of a force plate.
FACTORS = (0.03, 0.1, 0.3, 1.0)
# Logarithm of the Bayes factor from which a kind of error drifts: 20 to 1.
LEAST_EVIDENCE = 3.0
# The weights of the rows need not be exact.
CONVERGED = 1e-2


def drift_by_evidence(
    possible: SensorDrift,
    errors: SensorErrors,
    observations: Observations,
    prior: Prior,
    pseudo_measurements: PseudoMeasurements | None,
    *,
    empirical: bool,
    count: int,
) -> SensorDrift | None:
    """Return the walks that make a log most probable; None if its sensors do not drift.

    All sensors of a kind have the same factor on their deviations. The weights of the rows are
    those of the widest walks, with residuals that are correlated in time counted as fewer ones.

    Parameters
    ----------
    possible : SensorDrift
    errors : SensorErrors
    observations : Observations
        Rows with the columns of the possible changes last.
    prior : Prior
        Of all unknowns, with the widest walks.
    pseudo_measurements : PseudoMeasurements or None
    empirical, count
        See :func:`~symbid_ros.estimation.posterior.posterior`.
    """
    widest = posterior(
        observations,
        prior,
        pseudo_measurements,
        empirical=empirical,
        count=count,
        tolerance=CONVERGED,
        approximate=True,
    )
    root = np.sqrt(correlation_factors(widest, observations))
    precision = np.linalg.inv(widest.covariance * np.outer(root, root))
    moment = observations.rows.whitened_moment(precision)
    if pseudo_measurements is not None:
        rows = np.column_stack([pseudo_measurements.rows, pseudo_measurements.targets])
        moment = moment + rows.T @ rows
    G, Gy = moment[:-1, :-1], moment[:-1, -1]
    g = Gy - G @ prior.mean
    constants = len(prior.mean) - len(possible.names(errors))
    base = widest.prior.covariance_factor()[:constants, :constants]

    def evidence(factors: FloatArray) -> float:
        """Return the logarithm of the data's probability, but for a constant."""
        walks = possible.scaled(factors)
        if walks is None:
            L = base
            kept = np.arange(constants)
        else:
            L = block_diag(base, walks.covariance_factor)
            some = np.tile(factors > 0, len(possible.knots) - 1)
            kept = np.r_[np.arange(constants), constants + np.flatnonzero(some)]
        H = L.T @ G[np.ix_(kept, kept)] @ L + np.eye(len(kept))
        lower = cho_factor(H)
        x = L.T @ g[kept]
        return float(0.5 * x @ cho_solve(lower, x) - np.sum(np.log(lower[0].diagonal())))

    kinds = [kind for kind in DRIFTING_KINDS if kind in errors.kinds]
    choices = {
        factors: evidence(possible.factors(errors, dict(zip(kinds, factors, strict=True))))
        for factors in product((0.0, *FACTORS), repeat=len(kinds))
    }
    # Each kind that drifts must be worth its complication.
    best = max(choices, key=lambda one: choices[one] - LEAST_EVIDENCE * np.count_nonzero(one))
    return possible.scaled(possible.factors(errors, dict(zip(kinds, best, strict=True))))
