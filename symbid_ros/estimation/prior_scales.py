"""How far to trust a prior: factors on its deviations that make the data most probable."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from symbid_ros.arrays import FloatArray

# Range of the factor that the evidence may put on the prior's deviations. A payload that the model
# lacks needs thousands on a last link of a few grams.
SCALES = (1e-2, 1e4)
# Deviation of the logarithm of the ratio of two factors: one kind of error may be e² times larger.
RATIO_STD = 2.0
# Deviation of the logarithm of a factor below one. Without it, data that hold one or two
# directions, in which the stated values happen to be right, would call all values exact.
NARROWING_STD = 1.0
# Newton steps of the search for these factors at most, the longest and the shortest in their
# logarithms, and by how much the cost must still fall.
SEARCH_STEPS, LONGEST_STEP, SHORTEST_STEP, LEAST_FALL = 50, 1.0, 1e-9, 1e-12

# A cost, its gradient (k,) and its Hessian (k, k).
_Cost = tuple[float, FloatArray, FloatArray]


@dataclass(frozen=True)
class PriorEvidence:
    """Rows A x = b of some parameters x, in prior deviations, with independent unit noise.

    Attributes
    ----------
    A : (r, count) float64
    b : (r,) float64
    """

    A: FloatArray
    b: FloatArray

    def common_scale(self) -> float:
        """Return the factor λ on all deviations that makes the data most probable."""
        U, values, _ = np.linalg.svd(self.A, full_matrices=False)
        square, fit = values**2, (U.T @ self.b) ** 2

        def cost(log_scale: FloatArray) -> _Cost:
            ratio = np.exp(2 * log_scale) * square
            known, unknown = ratio / (1 + ratio), 1 / (1 + ratio)
            value = np.sum(np.log1p(ratio) - known * fit)
            slope = 2 * np.sum(known * (1 - unknown * fit))
            bend = 4 * np.sum(known * unknown * (1 + (known - unknown) * fit))
            return _with_narrowing(log_scale, (float(value), np.array([slope]), np.array([[bend]])))

        grid = np.linspace(np.log(SCALES[0]), np.log(SCALES[1]), 37)[:, None]
        best = min(grid, key=lambda point: cost(point)[0])
        return float(np.exp(_minimum(cost, best)[0]))

    def two_scales(self, share: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """Return the logarithms (2,) of the factors λ and μ on two kinds of errors.

        The variance of x_i is s_i λ² + (1 - s_i) μ². The factors maximise the evidence times a
        prior of their ratio, without which data that hold few directions of one kind would make it
        vanish.

        Parameters
        ----------
        share : (count,) float64
            s, the share of the first kind.
        start : (2,) float64, optional
            Where to begin; at the common factor by default.
        """
        if start is None:
            start = np.full(2, np.log(self.common_scale()))
        shares, ratio = np.array([share, 1 - share]), np.array([1.0, -1.0]) / RATIO_STD

        def cost(logs: FloatArray) -> _Cost:
            variances = np.exp(2 * logs)[:, None] * shares
            C = cholesky((self.A * variances.sum(axis=0)) @ self.A.T + np.eye(len(self.b)))
            Z = solve_triangular(C, np.column_stack([self.A, self.b]), trans="T")
            Z, z = Z[:, :-1], Z[:, -1]
            Q, q = Z.T @ Z, Z.T @ z
            value = 2 * np.log(C.diagonal()).sum() + z @ z + (ratio @ logs) ** 2
            gradient = 2 * variances @ (Q.diagonal() - q**2)
            curvature = Q * (2 * np.outer(q, q) - Q)
            bend = 2 * np.diag(gradient) + 4 * variances @ curvature @ variances.T
            gradient = gradient + 2 * (ratio @ logs) * ratio
            bend = bend + 2 * np.outer(ratio, ratio)
            return _with_narrowing(logs, (float(value), gradient, bend))

        return _minimum(cost, start)


def _with_narrowing(logs: FloatArray, cost: _Cost) -> _Cost:
    """Return a cost with that of factors below one added."""
    value, gradient, bend = cost
    below = np.minimum(logs, 0.0) / NARROWING_STD**2
    return (
        value + float(below @ logs),
        gradient + 2 * below,
        bend + np.diag(np.where(logs < 0, 2 / NARROWING_STD**2, 0.0)),
    )


def _minimum(cost: Callable[[FloatArray], _Cost], start: FloatArray) -> FloatArray:
    """Return where logarithms of factors (k,), near a start and within ``SCALES``, cost least.

    Newton steps that go downhill where the cost is concave too (Dauphin et al. 2014, NIPS 27), and
    are halved until the cost falls.
    """
    logs = start
    value, gradient, bend = cost(logs)
    for _ in range(SEARCH_STEPS):
        values, V = np.linalg.eigh(bend)
        along = V.T @ gradient
        size = np.maximum(np.abs(values), np.finfo(float).tiny)
        if along @ (along / size) < LEAST_FALL:
            break
        step = -V @ (along / size)
        step *= min(1.0, LONGEST_STEP / np.linalg.norm(step))
        following = np.clip(logs + step, *np.log(SCALES))
        found = cost(following)
        while found[0] > value and np.abs(following - logs).max() > SHORTEST_STEP:
            following = (logs + following) / 2
            found = cost(following)
        if found[0] >= value:
            break
        logs, (value, gradient, bend) = following, found
    return logs
