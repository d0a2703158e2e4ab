"""Gaussian posterior of the parameters from observations and a prior: the method ``map``.

With φ = φ̄ + L x, x ~ N(0, 1), the rows are whitened by the covariance Σ of their residuals across
coordinates. The most probable x solves (AᵀA - NᵀN + 1) x = Aᵀb - Nᵀc. Here A x = b are the rows
and N x = c is their noise. The noise must be subtracted, because noise in K adds to AᵀA like
information (errors in variables). Σ is the covariance of the residuals at the solution, so Σ and
x are computed alternately. The factor of the data suffices for that, without a second pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.estimation.block_matrices import independent_blocks, without_zeros
from symbid_ros.estimation.directions import square_factor
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.quadratic_cost import QuadraticCost

REWHITENINGS = 20
CONVERGED = 1e-9  # in posterior standard deviations
# Later iterations, or those closer to convergence, need all digits.
APPROXIMATE_TOLERANCE, APPROXIMATE_TURNS = 1e-6, 15
# Changes below this that no longer halve are rounding.
ROUNDING = 1e-5


@dataclass(frozen=True)
class PseudoMeasurements:
    """Constraints with uncertainty: rows @ φ = targets, each with a standard deviation of one.

    Attributes
    ----------
    rows : (k, p) float64
    targets : (k,) float64
    has_weighing : bool
        Whether the first row is the weighed mass of the robot, in units of its deviation.
    """

    rows: FloatArray
    targets: FloatArray
    has_weighing: bool = False

    @property
    def weighing_std(self) -> float:
        """Standard deviation of the weighing, kg; 0 without one."""
        return 1 / float(self.rows[0].max()) if self.has_weighing else 0.0


def stacked(
    rows: PseudoMeasurements | None, more: PseudoMeasurements | None
) -> PseudoMeasurements | None:
    """Return the pseudo-measurements of both, those of ``rows`` first."""
    if rows is None or more is None:
        return more if rows is None else rows
    return replace(
        rows,
        rows=np.vstack([rows.rows, more.rows]),
        targets=np.append(rows.targets, more.targets),
    )


@dataclass(frozen=True)
class Posterior:
    """A Gaussian over the parameters.

    Attributes
    ----------
    mean : (p,) float64
        Most probable parameters, in SI units.
    factor : (p, p) float64
        R: the minimised square is ‖R (φ - mean)‖². The covariance is (RᵀR)⁻¹ if residuals are
        independent in time.
    prior : Prior
        Distribution before the data.
    covariance : (n, n) float64
        Covariance Σ of a row's residual.
    prior_scale : float
        Factor on the deviations of ``prior`` that makes the data most probable; 1 if the evidence
        has chosen them.
    chosen_scale : float
        Root mean square factor that the evidence has put on the deviations already; 1 if they are
        as stated.
    is_scaled : bool
        Whether the evidence chose that factor.
    noise_share : float
        Largest share of a direction's apparent information that is noise in the regressor, but for
        one direction in a hundred.
    excess_score : (p, k) float64 or None
        N: correlation of the residuals in time adds the covariance N Nᵀ to the score, see
        :mod:`symbid_ros.estimation.sandwich`. None without such correlation.
    other_models : (p, k) float64 or None
        N: models that explain the data as well add the covariance N Nᵀ.
    unseen : (p, p) float64 or None
        N: directions that the data do not show, in which the prior was narrowed for others, add the
        covariance N Nᵀ.
    """

    mean: FloatArray
    factor: FloatArray
    prior: Prior
    covariance: FloatArray
    prior_scale: float
    noise_share: float
    chosen_scale: float = 1.0
    is_scaled: bool = False
    excess_score: FloatArray | None = None
    other_models: FloatArray | None = None
    unseen: FloatArray | None = None

    @cached_property
    def independent_factor(self) -> FloatArray:
        """(p, p) R⁻¹, L of the covariance if residuals are independent in time."""
        scale = self.prior.std
        factor: FloatArray = scale[:, None] * np.linalg.solve(
            self.factor * scale, np.eye(len(scale))
        )
        return factor

    @cached_property
    def deviation_factor(self) -> FloatArray:
        """L (p, p) with covariance L Lᵀ."""
        factor = self.independent_factor
        score = self.excess_score
        excess = None if score is None else factor @ (factor.T @ score)
        roots = factor, excess, self.other_models, self.unseen
        parts = [one for one in roots if one is not None]
        return square_factor(np.concatenate(parts, axis=1))

    @cached_property
    def parameter_covariance(self) -> FloatArray:
        """Covariance (p, p) of all parameters."""
        product: FloatArray = self.deviation_factor @ self.deviation_factor.T
        return product

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviations (p,)."""
        std: FloatArray = np.sqrt(np.sum(self.deviation_factor**2, axis=1))
        return std

    @cached_property
    def prior_factor(self) -> FloatArray:
        """L₀ (p, p) with covariance L₀ L₀ᵀ before the data, wide where these show nothing."""
        factor = self.prior.covariance_factor()
        if self.unseen is None:
            return factor
        return square_factor(np.concatenate([factor, self.unseen], axis=1))

    def gain(self, count: int) -> float:
        """Return the information gained about the first ``count`` parameters, nat.

        It is half the logarithm of the ratio of the marginal covariances' determinants.
        """

        def log_volume(factor: FloatArray) -> float:
            rows = factor[:count] / self.prior.std[:count, None]
            triangle = np.asarray(np.linalg.qr(rows.T, mode="r"), dtype=np.float64)
            return float(np.sum(np.log(np.abs(triangle.diagonal()))))

        return log_volume(self.prior_factor) - log_volume(self.deviation_factor)


def _principal(
    kinds: Sequence[FloatArray], sizes: FloatArray, blocks: Sequence[IntArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the axes (m, m) and deviations (m,) of errors of several kinds, of these sizes.

    Errors are independent between the ``blocks``.
    """
    if len(kinds) == 1:
        return np.eye(len(kinds[0])), np.full(len(kinds[0]), sizes[0])
    axes, deviations = np.zeros_like(kinds[0]), np.zeros(len(kinds[0]))
    for block in blocks:
        place = np.ix_(block, block)
        wide = np.hstack([size * root[place] for size, root in zip(sizes, kinds, strict=True)])
        axes[place], deviations[block], _ = np.linalg.svd(wide, full_matrices=False)
    return axes, deviations


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
    correlation: FloatArray | None = None,
) -> Posterior:
    """Return the Gaussian posterior of the parameters.

    Parameters
    ----------
    observations : Observations
        Observations of the logs.
    prior : Prior
        Mean and covariance of the parameters before the data.
    pseudo_measurements : PseudoMeasurements, optional
        Further constraints with uncertainty, such as a weighing.
    empirical : bool
        Whether the evidence chooses a common factor on the prior's deviations, or one for each
        kind of error if the prior knows several.
    count : int, optional
        Number of leading parameters whose deviations the evidence judges, those of the links.
        All by default. Those of ``prior.payloads`` are not judged.
    tolerance : float
        Change in posterior standard deviations at which weights and solution have converged.
    start : (p,) float64, optional
        Parameters whose residuals give the initial weights; the prior's mean by default.
    approximate : bool
        Whether to stop at half of the digits, which is enough for comparisons.
    correlation : (n,) float64, optional
        Factor on each coordinate's residual variance, for residuals that are correlated in time.
    """
    mean = prior.mean
    count = len(mean) if count is None else count
    judged = prior.judged(count)
    kinds = prior.kinds_of_errors(judged) if empirical else []
    blocks = independent_blocks(*kinds) if len(kinds) > 1 else []
    L, axes = prior.covariance_factor(), np.eye(len(mean))
    # From [K y] to rows in prior deviations: [K y] to_prior = [K L, y - K mean].
    to_prior = without_zeros(np.block([[L, -mean[:, None]], [np.zeros(len(mean)), 1.0]]))
    # As few residuals as these may be the prior's errors or noise, above all at rest: if all were
    # noise, the prior would seem exact.
    is_few = observations.rows.samples <= len(observations.rows.layout.coordinates)
    measured = np.zeros((0, len(mean) + 1))
    if pseudo_measurements is not None:
        measured = np.column_stack([pseudo_measurements.rows, pseudo_measurements.targets])
    scale, logs = np.ones(len(mean)), None
    x = np.zeros(len(mean)) if start is None else np.linalg.solve(L, start - mean)
    # Weights and solution alternate. Most iterations are the early ones, which need fewer digits.
    coarse, last = True, np.inf
    for turn in range(REWHITENINGS):
        cost = QuadraticCost.of(
            observations,
            mean + L @ x,
            mean,
            to_prior,
            measured,
            approximate=coarse,
            correlation=correlation,
        )
        if empirical:
            logs = cost.evidence(judged).scales(kinds, logs)
            if is_few:
                logs = np.maximum(logs, 0.0)
            axes[np.ix_(judged, judged)], scale[judged] = _principal(kinds, np.exp(logs), blocks)
            if len(kinds) > 1:
                cost = cost.turned(axes)
        before = x
        x, factor = cost.minimum(scale)
        few = without_zeros(axes)
        x, factor = few @ x, factor @ few.T
        change = np.linalg.norm(factor @ (x - before)) / np.sqrt(len(x))
        is_rounding = 0.5 * last < change < ROUNDING
        if not coarse and (change < tolerance or is_rounding):
            break
        is_close = change <= max(tolerance, APPROXIMATE_TOLERANCE) or turn >= APPROXIMATE_TURNS
        coarse, last = coarse and not is_close and not is_rounding, change
        if approximate and not coarse:
            break
    phi = mean + L @ x
    turned = L @ axes
    chosen = prior.with_root(turned * scale) if len(kinds) > 1 else prior.widened(scale)
    unseen = cost.unseen(scale)
    precision = np.asarray(solve_triangular(L, factor.T, trans="T", lower=True).T, dtype=np.float64)
    return Posterior(
        mean=phi,
        factor=precision,
        prior=chosen,
        covariance=cost.covariance,
        prior_scale=1.0 if empirical else cost.evidence(judged).common_scale(),
        noise_share=cost.noise_share(scale),
        chosen_scale=float(np.sqrt(np.mean((chosen.std / prior.std)[judged] ** 2))),
        is_scaled=empirical,
        unseen=None if unseen is None else turned @ unseen,
    )
