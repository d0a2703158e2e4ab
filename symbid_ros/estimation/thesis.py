"""The thesis's four methods: one least-squares problem, scaled four ways, truncated.

All of them solve W̃ φ̃ = ỹ with W̃ = G W H, ỹ = G (y - W γ), φ = H φ̃ + γ by truncated
SVD (Eq. 15-27), where γ = φ̄ is the prior mean. For H = I that is Eq. 21 with
the nullspace of Eq. 23, since V_e α̂_e + V_n V_nᵀ φ̄ = φ̄ + V_e (α̂_e - V_eᵀ φ̄).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.prior import Prior

Method = Literal["ols", "wls_r", "wls_c", "wls_rc"]
METHODS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True)
class ScaledProblem:
    """G W H φ̃ = G (y - W φ̄), decomposed.

    Attributes
    ----------
    scale : (p,) float64
        Diagonal of H.
    prior : (p,) float64
        φ̄.
    left : (p,) float64
        Uᵀ ỹ, the data in the singular directions.
    singular_values : (p,) float64
        Descending.
    directions : (p, p) float64
        V, one singular direction of φ̃ per column.
    unexplained : float
        ‖ỹ‖² that no parameters can explain.
    samples : int
        Number of samples N.
    """

    scale: FloatArray
    prior: FloatArray
    left: FloatArray
    singular_values: FloatArray
    directions: FloatArray
    unexplained: float
    samples: int

    @cached_property
    def rank(self) -> int:
        """Numerical rank m: singular values above the rounding of the largest."""
        values = self.singular_values
        if values[0] == 0:
            return 0
        return int(np.sum(values > 1e-11 * values[0]))

    def solutions(self) -> FloatArray:
        """Return φ̂ (p, m) for every truncation z = 1 ... m, one per column."""
        m = self.rank
        steps = self.directions[:, :m] * (self.left[:m] / self.singular_values[:m])
        return self.prior[:, None] + self.scale[:, None] * np.cumsum(steps, axis=1)

    def solution(self, z: int) -> FloatArray:
        """Return φ̂ (p,) with the z largest singular values."""
        steps = self.directions[:, :z] @ (self.left[:z] / self.singular_values[:z])
        return self.prior + self.scale * steps

    def std(self, z: int, prior_std: FloatArray) -> FloatArray:
        """Return the standard deviation (p,) of φ̂: Eq. 33-34 plus the prior's where truncated.

        The data's part assumes white residuals of equal size, as Eq. 33 does, and the
        prior's part independent parameters; filtering and noise in the regressor
        make the first optimistic.
        """
        squares = self.unexplained + np.sum(self.left[z:] ** 2)
        variance = squares / max(self.samples - z, 1)
        used, unused = self.directions[:, :z], self.directions[:, z:]
        data = np.sum((used / self.singular_values[:z]) ** 2, axis=1) * variance
        remaining = self.scale[:, None] * (unused @ unused.T) * (prior_std / self.scale)
        std: FloatArray = np.sqrt(self.scale**2 * data + np.sum(remaining**2, axis=1))
        return std


def scaled_problem(
    information: Information,
    prior: Prior,
    method: Method,
    row_deviation: FloatArray | None = None,
) -> ScaledProblem:
    """Scale and decompose the least-squares problem of one method.

    Parameters
    ----------
    information : Information
        The data.
    prior : Prior
        φ̄, and H = diag(|φ̄|) for the column-scaled methods.
    method : {"ols", "wls_r", "wls_c", "wls_rc"}
        Which of G and H are used.
    row_deviation : (n,) float64, optional
        σ per coordinate for the row-scaled methods, such as the sensors' (Eq. 28).
        By default that of the OLS residual (Eq. 29-30).
    """
    n = len(information.layout.coordinates)
    G = np.eye(n)
    if method in ("wls_r", "wls_rc"):
        deviation = (
            residual_deviation(information, prior) if row_deviation is None else row_deviation
        )
        G = np.diag(1.0 / deviation)
    scale = column_scale(prior) if method in ("wls_c", "wls_rc") else np.ones(len(prior.names))
    return _decomposed(information, prior.mean, scale, G)


def column_scale(prior: Prior) -> FloatArray:
    """Return H's diagonal: |φ̄|, and the prior's deviation where φ̄ is zero.

    A zero would forbid the parameter ever to move.
    """
    return np.where(prior.mean != 0, np.abs(prior.mean), prior.std)


def residual_deviation(information: Information, prior: Prior) -> FloatArray:
    """Return the deviation (n,) of the OLS residual in each coordinate (Eq. 29-30).

    Each coordinate's degrees of freedom are N less its share of the rank, the
    trace of its block of the hat matrix, instead of Eq. 30's N - p.
    """
    problem = _decomposed(
        information,
        prior.mean,
        np.ones(len(prior.names)),
        np.eye(len(information.layout.coordinates)),
    )
    m = problem.rank
    squares = np.diag(information.residual_moment(problem.solution(m)))
    weights = problem.directions[:, :m] / problem.singular_values[:m]
    share = np.array(
        [
            np.sum((information.coordinate_factor(i)[:, :-1] @ weights[columns]) ** 2)
            for i, columns in enumerate(information.layout.columns)
        ]
    )
    freedom = information.samples - share
    if np.any(freedom < 1):
        raise EstimateError(
            f"{information.samples} samples are too few for {m} parameters; record longer"
        )
    deviation = np.sqrt(squares / freedom)
    # A coordinate that nothing moves or loads has no residual; its weight must stay finite.
    floored: FloatArray = np.maximum(deviation, 1e-9 * max(float(deviation.max()), 1e-300))
    return floored


def _decomposed(
    information: Information, prior: FloatArray, scale: FloatArray, G: FloatArray
) -> ScaledProblem:
    factor = information.whitened(G)
    A, b = factor[:, :-1], factor[:, -1]
    U, values, Vt = np.linalg.svd(A * scale, full_matrices=False)
    target = b - A @ prior
    left = U.T @ target
    unexplained = max(float(target @ target - left @ left), 0.0)
    return ScaledProblem(scale, prior, left, values, Vt.T, unexplained, information.samples)
