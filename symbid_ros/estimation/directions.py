"""Information that the data add to the prior, by direction of parameter space and by link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.errors import EstimateError, PriorError
from symbid_ros.model.inertia import PARAMETERS

# A parameter or direction is determined if the data say more about it than the prior, which halves
# the variance. This is the largest ratio of standard deviations.
DETERMINED = 1 / np.sqrt(2)
# Condition number above which the prior's covariance is numerically singular.
_CONDITION = 1e12
# Smallest loading that is printed, relative to the largest one.
_WORTH_READING = 0.2


@dataclass(frozen=True)
class DeterminedDirections:
    """The posterior covariance against the prior's, P d = r² P₀ d, most determined first.

    In the coordinates ξ = C φ the prior has covariance I and the posterior diag(r²). The data
    reduce the standard deviation of each ξ_i by r_i, independently of the others (Golub and Van
    Loan 2013, Matrix Computations, sec. 8.7).

    Attributes
    ----------
    names : tuple of str
        Names of the p parameters.
    threshold : float
        Ratio below which a direction is determined.
    ratios : (p,) float64
        Ratio r of posterior to prior standard deviation of each direction, ascending; 1 where
        correlated residuals make the estimate less certain than the prior.
    directions : (p, p) float64
        Columns of D = C⁻¹, the change of φ for one prior standard deviation of ξ_i, in the
        parameters' units. D Dᵀ is the prior's covariance, D diag(r²) Dᵀ the posterior's.
    coordinates : (p, p) float64
        Rows of C, the combinations of parameters that define ξ.
    prior_std : (p,) float64
        Prior standard deviation of each parameter.
    link_gain : dict of str to float
        Per link half the base-2 logarithm of det(prior block) over det(posterior block) of its
        ten parameters, bit. The sum is less than the total gain if the data determine links only
        in combination.
    """

    names: tuple[str, ...]
    threshold: float
    ratios: FloatArray
    directions: FloatArray
    coordinates: FloatArray
    prior_std: FloatArray
    link_gain: dict[str, float]

    @property
    def determined(self) -> BoolArray:
        """(p,) directions that the data rather than the prior determine."""
        return np.asarray(self.ratios < self.threshold)

    @property
    def gain(self) -> float:
        """Information gain about all parameters together, bit."""
        return _bits(self.ratios)

    @property
    def effective(self) -> float:
        """Effective number of determined parameters, Σ (1 - r²) (MacKay 1992)."""
        return float(np.sum(1 - self.ratios**2))

    @property
    def loadings(self) -> FloatArray:
        """(p, p) prior correlations of parameters (rows) with ξ (columns)."""
        loadings: FloatArray = self.directions / self.prior_std[:, None]
        return loadings

    def describe(self, index: int, terms: int = 4) -> str:
        """Return the largest loadings of a direction, such as ``+0.92 foot/m -0.31 shank/m``."""
        loading = self.loadings[:, index]
        largest = np.argsort(-np.abs(loading), kind="stable")[:terms]
        worth = np.abs(loading[largest]) >= _WORTH_READING * abs(loading[largest[0]])
        return " ".join(f"{loading[k]:+.2f} {self.names[k]}" for k in largest[worth])


def count_determined(prior_factor: FloatArray, posterior_factor: FloatArray) -> int:
    """Return the number of directions that the data determine, from factors with p rows."""
    prior, after = square_factor(prior_factor), square_factor(posterior_factor)
    std = np.linalg.norm(prior, axis=1)[:, None]
    # The singular values are the ratios of standard deviations.
    ratios = np.linalg.svd(np.linalg.solve(prior / std, after / std), compute_uv=False)
    return int(np.sum(ratios < DETERMINED))


def describe_determined(combinations: int | None, single: int, count: int) -> str:
    """Return how many of ``count`` parameters are determined, together and alone."""
    alone = f"{single} of {count} single parameters"
    if combinations is None:
        return alone
    return f"{combinations} of {count} parameter combinations, {alone}"


def square_factor(factor: FloatArray) -> FloatArray:
    """Return a square factor (p, p) of the covariance that a factor with p rows has."""
    if factor.shape[0] == factor.shape[1]:
        return factor
    triangle = np.asarray(np.linalg.qr(factor.T, mode="r"), dtype=np.float64)
    return triangle.T


def determined_directions(
    prior_factor: FloatArray, posterior_factor: FloatArray, names: Sequence[str], threshold: float
) -> DeterminedDirections:
    """Compare a posterior with its prior, direction by direction.

    Parameters
    ----------
    prior_factor, posterior_factor : (p, p) float64
        Any L₀ and L with covariances L₀ L₀ᵀ and L Lᵀ, in the parameters' units. Only the
        posterior's covariance may be singular.
    names : sequence of str
        Names of the p parameters, ``<link>/<m|mc_x|...|Izz>`` or ``<joint>/<term>``.
    threshold : float
        Largest ratio of standard deviations at which a direction counts as determined.

    Raises
    ------
    PriorError
        When the prior's covariance is singular.
    EstimateError
        When a factor is not finite.
    """
    if not (np.all(np.isfinite(prior_factor)) and np.all(np.isfinite(posterior_factor))):
        raise EstimateError(
            "a covariance factor of the prior or the posterior is not finite; solve again", "E417"
        )
    prior_std = np.linalg.norm(prior_factor, axis=1)
    vanishing = np.flatnonzero(prior_std == 0)
    if len(vanishing):
        raise PriorError(
            f"the prior is certain of {names[vanishing[0]]}; give it a positive standard deviation",
            "E408",
        )
    # Prior deviations as units make kg and kg m² comparable.
    scaled = prior_factor / prior_std[:, None]
    if np.linalg.cond(scaled) > _CONDITION:
        raise PriorError(
            "the prior is certain of a combination of parameters; widen its covariance factor",
            "E408",
        )
    whitened = np.linalg.solve(scaled, posterior_factor / prior_std[:, None])
    axes, ratios, _ = np.linalg.svd(whitened)
    axes, ratios = axes[:, ::-1], ratios[::-1]
    loadings = scaled @ axes
    largest = np.abs(loadings).argmax(axis=0)
    axes = axes * np.where(np.take_along_axis(loadings, largest[None], axis=0)[0] < 0, -1.0, 1.0)
    return DeterminedDirections(
        names=tuple(names),
        threshold=threshold,
        ratios=np.minimum(ratios, 1.0),
        directions=prior_factor @ axes,
        coordinates=np.linalg.solve(scaled.T, axes).T / prior_std,
        prior_std=prior_std,
        link_gain=_link_gain(prior_factor, posterior_factor, names),
    )


def _link_gain(prior: FloatArray, posterior: FloatArray, names: Sequence[str]) -> dict[str, float]:
    rows: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        link, _, parameter = name.rpartition("/")
        if parameter in PARAMETERS:
            rows.setdefault(link, []).append(index)
    gains = {}
    for link, block in rows.items():
        before, after = (np.linalg.qr(factor[block].T, mode="r") for factor in (prior, posterior))
        gains[link] = max(0.0, _bits(np.abs(np.diag(after) / np.diag(before))))
    return gains


def _bits(ratios: FloatArray) -> float:
    """Return -Σ log₂ r, which is infinite if a direction is known exactly."""
    with np.errstate(divide="ignore"):
        return float(-np.sum(np.log2(ratios)))
