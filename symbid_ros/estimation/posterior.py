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
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.block_matrices import independent_blocks, without_zeros
from symbid_ros.estimation.directions import square_factor
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.prior_scales import SCALES, PriorEvidence

REWHITENINGS = 20
CONVERGED = 1e-9  # in posterior standard deviations
# Later iterations, or those closer to convergence, need all digits.
APPROXIMATE_TOLERANCE, APPROXIMATE_TURNS = 1e-6, 15
# Changes below this that no longer halve are rounding.
ROUNDING = 1e-5

# Largest share of a direction's information that is subtracted as noise, which is only estimated.
MAX_NOISE_SHARE = 0.75
# Share of the prior's information by which noise may exceed the data's without a correction, where
# half of the digits suffice.
NEGLIGIBLE_EXCESS = 1e-6

# Information below which a direction is rounding, absolute (in prior deviations) or relative to the
# best one.
MIN_INFORMATION, MIN_RELATIVE_INFORMATION = 1e-6, 1e-12
# Factor on the prior's deviations of ± 25 % below which the file's values come from a log.
IDENTIFIED = 0.1
# Information below which a direction judges the prior with a limited weight, as the data know it to
# ten prior deviations only: its pull counts as this many deviations at most. A small effect that
# the model lacks would claim alone that the prior is wrong a hundredfold.
WEAK_INFORMATION, MOST_PULL = 1e-2, 6.0
# Information about the prior that is rounding at any scale of it.
NO_INFORMATION = 1e-12


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


@dataclass(frozen=True)
class _Square:
    """The cost xᵀG x - 2 gᵀx minus the noise's xᵀT x - 2 tᵀx, with x in prior deviations.

    Attributes
    ----------
    G : (p, p) float64
        Moments AᵀA of the rows.
    g : (p,) float64
        Moments Aᵀb of the rows with their right-hand sides.
    T : (p, p) float64
        Moments NᵀN of the noise in the rows.
    t : (p,) float64
        Moments Nᵀc of the noise on both sides.
    covariance : (n, n) float64
        Covariance that whitened the rows.
    rows : (k, p + 1) float64 or None
        [A b] with all digits, of which G and g have half; None if these suffice.
    """

    G: FloatArray
    g: FloatArray
    T: FloatArray
    t: FloatArray
    covariance: FloatArray
    rows: FloatArray | None

    @classmethod
    def of(
        cls,
        observations: Observations,
        phi: FloatArray,
        mean: FloatArray,
        to_prior: FloatArray | csr_array,
        pseudo_measurements: "PseudoMeasurements | None",
        *,
        approximate: bool,
        correlation: FloatArray | None = None,
    ) -> "_Square":
        """Return the square of rows [K y], which ``to_prior`` brings to prior deviations."""
        covariance = observations.residual_covariance(phi, mean)
        if correlation is not None:
            root = np.sqrt(correlation)
            covariance = covariance * np.outer(root, root)
        try:
            # An upper triangle: rows of a chain's last joints have few columns.
            root = cholesky(covariance[::-1, ::-1], lower=True)[::-1, ::-1]
        except np.linalg.LinAlgError:
            raise EstimateError(
                "the residuals at the prior's mean are too large to estimate their covariance; "
                "correct the prior value that is out of proportion",
                "E417",
            ) from None
        whitening = np.asarray(np.linalg.inv(root), dtype=np.float64)
        precision = whitening.T @ whitening
        rows, measured = None, np.zeros((0, len(mean) + 1))
        if pseudo_measurements is not None:
            measured = np.column_stack([pseudo_measurements.rows, pseudo_measurements.targets])
        if approximate:
            moment = observations.rows.whitened_moment(precision) + measured.T @ measured
            moment = to_prior.T @ moment @ to_prior
        else:
            rows = np.concatenate([observations.rows.whitened(whitening), measured]) @ to_prior
            moment = rows.T @ rows
        noise = to_prior.T @ observations.noise.whitened_moment(precision) @ to_prior
        noise *= observations.plausible_noise(phi, covariance)
        G, g = moment[:-1, :-1], moment[:-1, -1]
        return cls(G, g, noise[:-1, :-1], noise[:-1, -1], covariance, rows)

    def turned(self, axes: FloatArray) -> "_Square":
        """Return the square of the coordinates along orthonormal axes, the columns (p, p)."""
        rows, few = self.rows, without_zeros(axes)
        if rows is not None:
            rows = np.column_stack([rows[:, :-1] @ few, rows[:, -1]])
        return replace(
            self,
            G=few.T @ self.G @ few,
            g=few.T @ self.g,
            T=few.T @ self.T @ few,
            t=few.T @ self.t,
            rows=rows,
        )

    def minimum(self, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x (p,) and the factor R (p, p) of the precision."""
        found = self._from_moments(scale) if self.rows is None else None
        if found is not None:
            return found
        R, x = self._with_noise(scale)
        # Noise is subtracted along the generalised eigenvectors of noise and total information.
        inverse = solve_triangular(R, np.eye(len(R)))
        share, V = np.linalg.eigh(inverse.T @ self.T @ inverse)
        kept = np.clip(share, 0.0, MAX_NOISE_SHARE)
        pull = kept / np.where(share > 0, share, 1.0)
        step = V.T @ (inverse.T @ (self.T @ x - self.t))
        x = x + inverse @ (V @ (pull / (1 - kept) * step))
        factor = np.sqrt(1 - kept)[:, None] * (V.T @ (R * scale))
        if self.rows is None:
            squares, V = np.linalg.eigh(factor.T @ factor)
        else:
            _, values, Vt = np.linalg.svd(factor, full_matrices=False)
            squares, V = values**2, Vt.T
        # The noise is an estimate. Where it exceeds the information, only the prior remains.
        least = np.maximum(squares, 1.0)
        x = scale * (V @ (squares / least * (V.T @ (x / scale))))
        return x, np.sqrt(least)[:, None] * V.T / scale

    def noise_share(self, scale: FloatArray) -> float:
        """Return the largest share of a direction's information that is noise.

        One direction in a hundred is not regarded, such as that of a joint which hardly moves.
        Where noise dominates, the prior remains.
        """
        R, _ = self._with_noise(scale)
        inverse = solve_triangular(R, np.eye(len(R)))
        shares = np.linalg.eigvalsh(inverse.T @ self.T @ inverse)
        return float(max(shares[-1 - len(shares) // 100], 0.0))

    def _with_noise(self, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the factor R (p, p) of the precision and x (p,) before noise is subtracted."""
        p = len(self.g)
        if self.rows is None:
            precision = self.G * np.outer(scale, scale) + np.eye(p)
            try:
                R = cholesky(precision)
            except np.linalg.LinAlgError:
                # Rounding exceeds the prior's information.
                squares, V = np.linalg.eigh(precision)
                root = np.sqrt(np.maximum(squares, 1.0))[:, None] * V.T
                R = np.asarray(np.linalg.qr(root, mode="r"), dtype=np.float64)
            return R / scale, scale * cho_solve((R, False), scale * self.g)
        square = stacked_factor(self.rows, np.column_stack([np.diag(1 / scale), np.zeros(p)]))
        R = square[:p, :p]
        return R, solve_triangular(R, square[:p, p])

    def _from_moments(self, scale: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return :meth:`minimum` with half the digits.

        It is None where noise is so large a share of the information that less is subtracted.
        """
        outer, one = np.outer(scale, scale), np.eye(len(scale))
        total, noise = self.G * outer + one, self.T * outer
        try:
            cholesky(MAX_NOISE_SHARE * total - noise)
        except np.linalg.LinAlgError:
            return None
        precision, target = total - noise, scale * (self.g - self.t)
        try:
            # Only the prior remains where noise exceeds the information, which is nowhere here.
            cholesky(precision - (1 - NEGLIGIBLE_EXCESS) * one)
            R = cholesky(precision)
            x = cho_solve((R, False), target)
        except np.linalg.LinAlgError:
            squares, V = np.linalg.eigh(precision)
            least = np.maximum(squares, 1.0)
            x, R = V @ (V.T @ target / least), np.sqrt(least)[:, None] * V.T
        return scale * x, R / scale

    def unseen(self, scale: FloatArray) -> FloatArray | None:
        """Return N (p, p): directions with little information add the covariance N Nᵀ.

        A file that is right to a percent or two in the directions that a log shows was identified
        from another log, and says little of others. So deviations that the evidence narrows below
        ``IDENTIFIED`` hold as far as the data judge their direction: N is (1 + H)⁻¹ times what they
        lack of the stated deviations, with H the information in these. The estimate itself is that
        of the narrow prior, because faint effects that the model lacks would pull it far from the
        file in such directions.
        """
        if np.all(scale >= 1):
            return None
        lacking = np.sqrt(np.maximum(1 - scale**2, 0.0) / (1 + (scale / IDENTIFIED) ** 4))
        # A function of the matrix of information: one of each eigenvector's would depend on those
        # that rounding chooses where no row shows anything.
        information, V = np.linalg.eigh(self.G - self.T)
        root: FloatArray = (V / (1 + np.maximum(information, 0.0))) @ (V.T * lacking)
        return root

    def evidence(self, judged: IntArray) -> "PriorEvidence":
        """Return the evidence of the data for the deviations of some parameters.

        Σ is held constant (MacKay 1992, Neural Computation 4(3)), and noise in the regressor is
        subtracted here too.
        """
        ones = np.ones(len(self.g))
        x, R = self._from_moments(ones) or self.minimum(ones)
        # The gradient RᵀR x of the rows at the prior's mean is H x₀ plus noise of covariance G,
        # where H is G without the regressor's noise.
        H, gradient = R.T @ R - np.diag(ones), R.T @ (R @ x)
        values, V = np.linalg.eigh(self.G)
        some = values > max(MIN_INFORMATION, MIN_RELATIVE_INFORMATION * values[-1])
        root = V[:, some] / np.sqrt(values[some])
        A, b = root.T @ H, root.T @ gradient
        others = np.setdiff1d(np.arange(len(self.g)), judged)
        # Rows that remain after marginalising the other parameters.
        rows = np.column_stack([A[:, others], A[:, judged], b])
        of_prior = np.eye(len(others), rows.shape[1])
        left = stacked_factor(rows, of_prior)[len(others) :, len(others) :]
        U, values, Vt = np.linalg.svd(left[:, :-1], full_matrices=False)
        pull = U.T @ left[:, -1]
        most = np.where(values**2 < WEAK_INFORMATION, MOST_PULL, np.inf)
        # Links have more parameters than any motion shows.
        is_shown = SCALES[1] * values > np.sqrt(NO_INFORMATION)
        return PriorEvidence((values[:, None] * Vt)[is_shown], np.clip(pull, -most, most)[is_shown])


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
    scale, logs = np.ones(len(mean)), None
    x = np.zeros(len(mean)) if start is None else np.linalg.solve(L, start - mean)
    # Weights and solution alternate. Most iterations are the early ones, which need fewer digits.
    coarse, last = True, np.inf
    for turn in range(REWHITENINGS):
        square = _Square.of(
            observations,
            mean + L @ x,
            mean,
            to_prior,
            pseudo_measurements,
            approximate=coarse,
            correlation=correlation,
        )
        if empirical:
            logs = square.evidence(judged).scales(kinds, logs)
            if is_few:
                logs = np.maximum(logs, 0.0)
            axes[np.ix_(judged, judged)], scale[judged] = _principal(kinds, np.exp(logs), blocks)
            if len(kinds) > 1:
                square = square.turned(axes)
        before = x
        x, factor = square.minimum(scale)
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
    unseen = square.unseen(scale)
    precision = np.asarray(solve_triangular(L, factor.T, trans="T", lower=True).T, dtype=np.float64)
    return Posterior(
        mean=phi,
        factor=precision,
        prior=chosen,
        covariance=square.covariance,
        prior_scale=1.0 if empirical else square.evidence(judged).common_scale(),
        noise_share=square.noise_share(scale),
        chosen_scale=float(np.sqrt(np.mean((chosen.std / prior.std)[judged] ** 2))),
        is_scaled=empirical,
        unseen=None if unseen is None else turned @ unseen,
    )
