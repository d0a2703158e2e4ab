"""Covariance of an estimate whose residuals are correlated in time.

The estimate minimises ‖Σ^(-1/2) (y - K φ)‖² + ‖L⁻¹ (φ - φ̄)‖². Let H be half the Hessian of this
cost. If the residuals are independent with covariance Σ, the estimate's covariance is H⁻¹. If they
are not, it is the sandwich H⁻¹ (Var s + L⁻ᵀ L⁻¹) H⁻¹ with the score s = Σ_t Kᵀ Σ⁻¹ e (Huber 1967;
White 1982, Econometrica 50(1)). Var s is found from blocks of time within which the residuals
are correlated (Liang and Zeger 1986, Biometrika 73(1)).

There are fewer blocks than parameters, so Var s as a matrix would be singular. Instead, each
coordinate i has one factor d_i on the variance of its residuals, from 1. With the correlation
matrix of Σ = S C S and its eigenvectors v_k, the combination k of residuals gets the mean factor
Σ_i v_ki² d_i. Combinations of strongly correlated coordinates thus keep their small variance. The
weights stay those of Σ: a covariance for long times as a weight would discard the information of
fast motion.
"""

from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior


def with_correlated_residuals(found: Posterior, observations: Observations) -> Posterior:
    """Return the posterior of these observations with a covariance for correlated residuals."""
    factors = correlation_factors(found, observations)
    if np.all(factors == 1.0):
        return found
    deviation = np.sqrt(found.covariance.diagonal())
    size, V = np.linalg.eigh(found.covariance / np.outer(deviation, deviation))
    # The excess of Σ's combinations, with the weight Σ⁻¹ on both sides.
    whitening = V / deviation[:, None]
    precision = (whitening * ((factors - 1) @ V**2 / size)) @ whitening.T
    moment = observations.rows.whitened_moment(precision)[:-1, :-1]
    scale = found.prior.std
    values, V = np.linalg.eigh(moment * np.outer(scale, scale))
    root = V * np.sqrt(np.maximum(values, 0.0)) / scale[:, None]
    return replace(found, excess_score=root)


def correlation_factors(found: Posterior, observations: Observations) -> FloatArray:
    """Return the factor (n,) on each coordinate's residual variance, from 1."""
    # Overlapping windows are part of Σ already.
    factors = observations.correlation(found.mean) / observations.inflation
    factors *= observations.variance_ratio(found.mean)
    return np.maximum(factors, 1.0)
