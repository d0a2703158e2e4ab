"""Cost of parameters by rows with noisy regressors, of which the noise is subtracted."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.block_matrices import without_zeros
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior_scales import SCALES, PriorEvidence

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
class QuadraticCost:
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
        measured: FloatArray,
        *,
        approximate: bool,
        correlation: FloatArray | None = None,
    ) -> "QuadraticCost":
        """Return the cost of parameters whose residuals at ``phi`` (p,) weight the rows.

        Parameters
        ----------
        observations : Observations
        phi, mean : (p,) float64
            Parameters, and the prior's mean.
        to_prior : (p + 1, p + 1) float64
            Brings rows [K y] to prior deviations.
        measured : (k, p + 1) float64
            Further rows and their targets, with a standard deviation of one.
        approximate : bool
            Whether half of the digits suffice.
        correlation : (n,) float64, optional
            Factor on each coordinate's residual variance.
        """
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
        rows = None
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

    def turned(self, axes: FloatArray) -> "QuadraticCost":
        """Return the cost of the coordinates along orthonormal axes, the columns (p, p)."""
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

    def evidence(self, judged: IntArray) -> PriorEvidence:
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
