"""Rows and a prior to a Gaussian posterior: the method ``map``.

With φ = φ̄ + L x, x ~ N(0, 1), and rows whitened across coordinates by the covariance Σ of their
residuals, the most probable x solves (AᵀA - NᵀN + 1) x = Aᵀb - Nᵀc. A x = b are the rows and
N x = c their noise part, which would otherwise pass for information: noise in K adds to AᵀA
whether or not the motion does (errors in variables). Σ follows from the residuals at the
solution, so the two are found in turn, from the one pass over the data that the wide factor is.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import brentq

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior

REWHITENINGS = 20
CONVERGED = 1e-9  # of a posterior standard deviation
APPROXIMATE_TOLERANCE, APPROXIMATE_TURNS = 1e-6, 15  # from here on digits count

# More of a direction's information than this is never called noise: its noise is only estimated.
NOISIEST = 0.75

# Directions of which data say less than this, in prior deviations, or too little beside others for
# a computer's digits, are not asked about the prior.
TOLD, DIGITS = 1e-6, 1e-12

# Factor by which the evidence may say that a prior is too wide or too narrow.
SCALES = (1e-2, 1e2)


@dataclass(frozen=True)
class PseudoMeasurements:
    """Knowledge that is no log's: rows @ φ = targets, each to a standard deviation of one.

    Attributes
    ----------
    rows : (k, p) float64
    targets : (k,) float64
    """

    rows: FloatArray
    targets: FloatArray


@dataclass(frozen=True)
class Posterior:
    """A Gaussian over the parameters.

    Attributes
    ----------
    mean : (p,) float64
        Most probable parameters, in SI units.
    factor : (p, p) float64
        R with (RᵀR)⁻¹ the covariance: the minimised square is ‖R (φ - mean)‖².
    prior : Prior
        What was believed before.
    covariance : (n, n) float64
        Σ of a row's residual.
    prior_scale : float
        The factor on the deviations of ``prior`` under which the data are most probable; 1 where
        the evidence has set them.
    noise_share : float
        Largest share of a direction's apparent information that was noise in the regressor.
    """

    mean: FloatArray
    factor: FloatArray
    prior: Prior
    covariance: FloatArray
    prior_scale: float
    noise_share: float

    @cached_property
    def deviation_factor(self) -> FloatArray:
        """L (p, p) with covariance L Lᵀ."""
        scale = self.prior.std
        scaled = self.factor * scale
        inverse = np.linalg.solve(scaled, np.eye(len(scale)))
        factor: FloatArray = scale[:, None] * inverse
        return factor

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviations (p,)."""
        std: FloatArray = np.sqrt(np.sum(self.deviation_factor**2, axis=1))
        return std

    def gain(self, count: int) -> float:
        """Return what was learnt of the first ``count`` parameters, whatever the others are.

        In nats: half the logarithm of the ratio of the covariances' determinants.
        """

        def log_volume(factor: FloatArray) -> float:
            rows = factor[:count] / self.prior.std[:count, None]
            return float(np.sum(np.log(np.linalg.svd(rows, compute_uv=False))))

        return log_volume(self.prior.covariance_factor()) - log_volume(self.deviation_factor)


@dataclass(frozen=True)
class _Square:
    """‖A x - b‖² less the noise's xᵀT x - 2 tᵀx, with x in prior deviations.

    Attributes
    ----------
    A : (k, p) float64
        Factor of the rows.
    b : (k,) float64
        Its right-hand side.
    T : (p, p) float64
        Moments NᵀN of the noise in the rows.
    t : (p,) float64
        Nᵀc of the noise in both their sides.
    covariance : (n, n) float64
        What whitened the rows.
    """

    A: FloatArray
    b: FloatArray
    T: FloatArray
    t: FloatArray
    covariance: FloatArray

    @classmethod
    def of(
        cls,
        observations: Observations,
        phi: FloatArray,
        mean: FloatArray,
        L: FloatArray,
        pseudo_measurements: "PseudoMeasurements | None",
        *,
        approximate: bool,
    ) -> "_Square":
        covariance = observations.residual_covariance(phi)
        try:
            root = cholesky(covariance, lower=True)
        except np.linalg.LinAlgError:
            raise EstimateError(
                "the residuals of the prior's mean are so large that rounding hides how they "
                "differ between coordinates; correct the value of the prior that is out of all "
                "proportion"
            ) from None
        whitening = np.asarray(np.linalg.inv(root), dtype=np.float64)
        precision = whitening.T @ whitening
        # From [K y] to rows in prior deviations: [K y] to_prior = [K L, y - K mean].
        to_prior = np.block([[L, -mean[:, None]], [np.zeros(len(mean)), 1.0]])
        if approximate:
            moment = observations.rows.whitened_moment(precision)
            rows = _root(to_prior.T @ moment @ to_prior)
        else:
            rows = observations.rows.whitened(whitening) @ to_prior
        A, b = rows[:, :-1], rows[:, -1]
        noise = to_prior.T @ observations.noise.whitened_moment(precision) @ to_prior
        noise *= observations.plausible_noise(phi, covariance)
        if pseudo_measurements is not None:
            A = np.concatenate([A, pseudo_measurements.rows @ L])
            b = np.concatenate([b, pseudo_measurements.targets - pseudo_measurements.rows @ mean])
        return cls(A, b, noise[:-1, :-1], noise[:-1, -1], covariance)

    def minimum(self, scale: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return x (p,), the precision's factor R (p, p) and the largest share of noise."""
        p = self.A.shape[1]
        square = stacked_factor(
            np.column_stack([self.A, self.b]),
            np.column_stack([np.diag(1 / scale), np.zeros(p)]),
        )
        R, target = square[:p, :p], square[:p, p]
        x = solve_triangular(R, target)
        # What noise added is taken off in the directions in which it is a share of the whole.
        inverse = solve_triangular(R, np.eye(p))
        share, V = np.linalg.eigh(inverse.T @ self.T @ inverse)
        kept = np.clip(share, 0.0, NOISIEST)
        pull = kept / np.where(share > 0, share, 1.0)
        step = V.T @ (inverse.T @ (self.T @ x - self.t))
        x = x + inverse @ (V @ (pull / (1 - kept) * step))
        factor = (V * np.sqrt(1 - kept)) @ V.T @ R
        # Noise is only estimated: where more of it than there is information would be taken off,
        # the prior alone is left.
        _, values, Vt = np.linalg.svd(factor * scale, full_matrices=False)
        least = np.maximum(values, 1.0)
        x = scale * (Vt.T @ ((values / least) ** 2 * (Vt @ (x / scale))))
        return x, least[:, None] * Vt / scale, float(share.max(initial=0.0))

    def evidence_scale(self, count: int) -> float:
        """Return the factor λ on the first ``count`` deviations that makes the data most probable.

        Σ is kept as it is (MacKay 1992, Neural Computation 4(3)), and noise in the regressor is
        no information here either.
        """
        x, R, _ = self.minimum(np.ones(self.A.shape[1]))
        # The gradient R'R x of the rows at the prior's mean is H x₀ plus noise of covariance W,
        # where H is what is left of W when the noise's part is taken off.
        values, V = np.linalg.eigh(self.A.T @ self.A)
        some = values > max(TOLD, DIGITS * values[-1])
        root = V[:, some] / np.sqrt(values[some])
        A, b = root.T @ (R.T @ R - np.eye(len(x))), root.T @ (R.T @ (R @ x))
        others = self.A.shape[1] - count
        # What is left of the rows when the other unknowns have taken up what they can.
        rows = np.column_stack([A[:, count:], A[:, :count], b])
        of_prior = np.eye(others, rows.shape[1])
        left = stacked_factor(rows, of_prior)[others:, others:]
        U, told, _ = np.linalg.svd(left[:, :-1], full_matrices=False)
        square, fit = told**2, (U.T @ left[:, -1]) ** 2

        def slope(log_scale: float) -> float:
            ratio = np.exp(2 * log_scale) * square
            return float(np.sum(ratio / (1 + ratio) * (1 - fit / (1 + ratio))))

        def cost(log_scale: float) -> float:
            ratio = np.exp(2 * log_scale) * square
            return float(np.sum(np.log1p(ratio) - ratio / (1 + ratio) * fit))

        grid = np.linspace(np.log(SCALES[0]), np.log(SCALES[1]), 25)
        best = int(np.argmin([cost(point) for point in grid]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        if slope(low) * slope(high) >= 0:
            return float(np.exp(grid[best]))
        return float(np.exp(brentq(slope, low, high)))


def _root(moment: FloatArray) -> FloatArray:
    """Return A with AᵀA the moment, as far as its digits tell."""
    values, V = np.linalg.eigh(moment)
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * V.T
    return root


def posterior(
    observations: Observations,
    prior: Prior,
    pseudo_measurements: PseudoMeasurements | None = None,
    *,
    empirical: bool = False,
    count: int | None = None,
    tolerance: float = CONVERGED,
    start: FloatArray | None = None,
    approximate: bool = False,
) -> Posterior:
    """Return the Gaussian posterior of the parameters.

    Parameters
    ----------
    observations : Observations
        The data.
    prior : Prior
        Mean and covariance of the parameters before the data.
    pseudo_measurements : PseudoMeasurements, optional
        What else is known, such as a weighing.
    empirical : bool
        Let the evidence choose a common factor on the prior's deviations.
    count : int, optional
        How many parameters, the first ones, the evidence judges the deviations of: those of
        the links. All by default.
    tolerance : float
        Change, in posterior standard deviations, at which weights and solution have settled.
    start : (p,) float64, optional
        Parameters whose residuals give the first weights, better ones than the prior's mean.
    approximate : bool
        Stop where half a computer's digits say no more: enough to compare, not to keep.
    """
    mean, L = prior.mean, prior.covariance_factor()
    count = len(mean) if count is None else count
    scale = np.ones(len(mean))
    x = np.zeros(len(mean)) if start is None else np.linalg.solve(L, start - mean)
    # Weights and solution are found in turn: roughly at first, as that takes most of the turns.
    coarse = True
    for turn in range(REWHITENINGS):
        square = _Square.of(
            observations, mean + L @ x, mean, L, pseudo_measurements, approximate=coarse
        )
        if empirical:
            scale[:count] = square.evidence_scale(count)
        before = x
        x, factor, share = square.minimum(scale)
        change = np.linalg.norm(factor @ (x - before)) / np.sqrt(len(x))
        if change < tolerance and not coarse:
            break
        coarse = (
            coarse and change > max(tolerance, APPROXIMATE_TOLERANCE) and turn < APPROXIMATE_TURNS
        )
        if approximate and not coarse:
            break
    phi = mean + L @ x
    precision = np.asarray(np.linalg.solve(L.T, factor.T).T, dtype=np.float64)
    return Posterior(
        mean=phi,
        factor=precision,
        prior=prior.widened(scale),
        covariance=square.covariance,
        prior_scale=square.evidence_scale(count) / float(scale[0]),
        noise_share=share,
    )
