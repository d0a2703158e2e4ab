"""How far to trust a prior: factors on its deviations that make the data most probable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.block_matrices import without_zeros

# Range of the factor that the evidence may put on the prior's deviations. A payload that the model
# lacks needs thousands on a last link of a few grams.
SCALES = (1e-2, 1e4)
# Deviation of the logarithm of the ratio of two factors: one kind of error may be e² times larger.
RATIO_STD = 2.0
# Deviation of the logarithm of a factor below one. Without it, data that hold one or two
# directions, in which the stated values happen to be right, would call all values exact.
NARROWING_STD = 1.0
# Small parts that a file lacks are a third kind of error, which can explain all that the others do.
# So the data must ask for it: its deviations are this share of the others', and the logarithm of
# the factor on them has this deviation.
MISSING_PARTS, PARTS_STD = 0.1, 1.0
# Newton steps of the search for these factors at most, the longest and the shortest in their
# logarithms, and by how much the cost must still fall.
SEARCH_STEPS, LONGEST_STEP, SHORTEST_STEP, LEAST_FALL = 50, 1.0, 1e-9, 1e-12

# A cost, its gradient (k,) and its Hessian (k, k).
_Cost = tuple[float, FloatArray, FloatArray]


@dataclass(frozen=True)
class PriorEvidence:
    """Rows A x = b (r,) of parameters x in prior deviations, with independent unit noise."""

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

    def scales(self, kinds: Sequence[FloatArray], start: FloatArray | None = None) -> FloatArray:
        """Return the logarithms (k,) of the factors on the deviations of several kinds of errors.

        The covariance of x is the sum of those of all kinds. The factors maximise the evidence
        times a prior: of the ratio of the first two, without which data that hold few directions of
        one kind would make it vanish, and of that on missing parts.

        Parameters
        ----------
        kinds : sequence of (count, m) float64
            A root of each kind's covariance: of other bodies, wrong numbers and missing parts.
        start : (k,) float64, optional
            Where to begin; at the common factor by default.
        """
        count = len(kinds)
        if count == 1:
            return np.log([self.common_scale()])
        if start is None:
            common = np.full(count, np.log(self.common_scale()))
            starts = [common, np.where(np.arange(count) < 2, common, 0.0)]
        else:
            starts = [start]
        moments = np.array([rows @ rows.T for rows in (self.A @ without_zeros(x) for x in kinds)])
        ratio = np.array([[1.0, -1.0] + [0.0] * (count - 2)]) / RATIO_STD
        precision = ratio.T @ ratio + np.diag([0.0, 0.0] + [1 / PARTS_STD**2] * (count - 2))
        narrow = np.array([1.0, 1.0] + [0.0] * (count - 2)) / NARROWING_STD**2

        def cost(logs: FloatArray) -> _Cost:
            variances = np.exp(2 * logs)
            C = cholesky(np.eye(len(self.b)) + np.tensordot(variances, moments, 1), lower=True)
            solved = cho_solve((C, True), np.column_stack([*moments, self.b]))
            z = solved[:, -1]
            spread = np.array(np.split(solved[:, :-1], count, axis=1))  # S⁻¹ M
            pulls = moments @ z
            away = precision @ logs + narrow * np.minimum(logs, 0.0)
            value = 2 * np.log(C.diagonal()).sum() + self.b @ z + logs @ away
            gradient = 2 * variances * (np.trace(spread, axis1=1, axis2=2) - pulls @ z)
            curvature = 2 * pulls @ (spread @ z).T - np.einsum("iab,jba->ij", spread, spread)
            bend = 2 * np.diag(gradient) + 4 * np.outer(variances, variances) * curvature
            bend += 2 * precision + np.diag(np.where(logs < 0, 2 * narrow, 0.0))
            return float(value), gradient + 2 * away, bend

        found = [_minimum(cost, one) for one in starts]
        if len(found) == 1:
            return found[0]
        return min(found, key=lambda logs: cost(logs)[0])


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
    are halved until the cost falls. Along a direction in which the cost hardly bends, such as a
    factor on which nothing depends, the step is at most the longest one.
    """
    logs = start
    value, gradient, bend = cost(logs)
    for _ in range(SEARCH_STEPS):
        values, V = np.linalg.eigh(bend)
        along = V.T @ gradient
        size = np.maximum(np.abs(values), np.abs(along) / LONGEST_STEP)
        size = np.maximum(size, np.finfo(float).tiny)
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
