"""Whether new rows still are of the robot that earlier ones were of, and which link is not.

With A and b the whitened new rows and φ ~ N(φ̂, P) what earlier rows tell, the innovation
e = b - A φ̂ has covariance C = 1 + A P Aᵀ as long as nothing changes. A link l whose parameters
have changed by δ adds A E_l δ. With δ ~ N(0, S) the logarithm of the ratio of both likelihoods,
the evidence for that change, is ½ gᵀ H⁻¹ g - ½ log det H, where M = C^(-1/2) A E_l S^(1/2),
H = 1 + Mᵀ M and g = Mᵀ C^(-1/2) e (Willsky and Jones 1976, IEEE Trans. Automatic Control 21(1),
with the change's size integrated out).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.prior_std import payload_std
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import WindowedRows

# Log-likelihood, nat, by which one link must fit new rows better than another to be named alone.
# A mass on a hinge's axis moves alike with either of its links: their evidence then differs only by
# how likely a payload of that size and place was thought to be.
TOLD_APART = 10.0

# What is left at last of the prior's weight: two of its standard deviations become one.
LEAST_WEIGHT = 0.25


@dataclass(frozen=True)
class LinkChange:
    """One link's change, as the new rows would have it.

    Attributes
    ----------
    link : str
    evidence : float
        That this link has changed and no other, against no change at all, nat.
    fit : float
        Log-likelihood that the change adds at its most probable size, nat: what the rows alone say.
    phi : (10,) float64
        What was added to its parameters, about its origin.
    std : (10,) float64
        Standard deviations of these.
    """

    link: str
    evidence: float
    fit: float
    phi: FloatArray
    std: FloatArray


@dataclass(frozen=True)
class Innovation:
    """New rows against what earlier ones led to expect.

    Attributes
    ----------
    misfit : float
        Mean square of what was not expected over its variance: 1 where nothing has changed.
    links : tuple of LinkChange
        Most evident first.
    """

    misfit: float
    links: tuple[LinkChange, ...]

    def suspects(self, usual: float = 1.0) -> tuple[LinkChange, ...]:
        """Return the links that explain the new rows about as well as the best one, best first.

        Parameters
        ----------
        usual : float
            Misfit of rows without a change: log-likelihoods are too large by this factor.
        """
        least = self.links[0].fit - TOLD_APART * usual
        return tuple(link for link in self.links if link.fit >= least)


def innovation(
    earlier: Posterior, recent: Sequence[WindowedRows], parameters: ParameterSet
) -> Innovation:
    """Compare new rows with what earlier rows predict.

    Parameters
    ----------
    earlier : Posterior
        By rows that came before, over windows of the same length. Its residual covariance
        includes the factor for overlapping windows, and so does the misfit.
    recent : sequence of WindowedRows
        The new rows, one of them at least.
    parameters : ParameterSet
        The robot's columns, the posterior's.
    """
    count = len(earlier.mean)
    root = cholesky(earlier.covariance, lower=True)
    whitening = np.asarray(np.linalg.inv(root), dtype=np.float64)
    factor = _whitened_factor(recent, whitening)
    A, b = factor[:count, :count], factor[:count, count]
    spread = A @ earlier.deviation_factor
    root = cholesky(np.eye(count) + spread @ spread.T, lower=True)
    unexpected = solve_triangular(root, b - A @ earlier.mean, lower=True)
    response = solve_triangular(root, A, lower=True)
    changes = []
    for index, scale in enumerate(payload_std(parameters, earlier.prior.mean)):
        M = response[:, 10 * index : 10 * index + 10] * scale
        H = np.eye(10) + M.T @ M
        g = M.T @ unexpected
        delta = np.linalg.solve(H, g)
        changes.append(
            LinkChange(
                parameters.link_names[index],
                float(g @ delta - np.linalg.slogdet(H)[1]) / 2,
                float(g @ delta - np.sum((M @ delta) ** 2) / 2),
                scale * delta,
                scale * np.sqrt(np.linalg.inv(H).diagonal()),
            )
        )
    return Innovation(
        misfit=float(unexpected @ unexpected) / count,
        links=tuple(sorted(changes, key=lambda change: -change.evidence)),
    )


def _whitened_factor(recent: Sequence[WindowedRows], whitening: FloatArray) -> FloatArray:
    """Return the triangular factor (p + 1, p + 1) of all rows G [K y]."""
    flat = [np.concatenate([part.mean.K, part.mean.y[:, :, None]], axis=2) for part in recent]
    rows = whitening @ np.concatenate(flat)
    return stacked_factor(rows.reshape(-1, rows.shape[2]))


def prior_weight(kept: float) -> float:
    """Return the prior's weight where ``kept`` of the first rows' is left, both from 0 to 1."""
    return max(kept, LEAST_WEIGHT)


def discounted_prior(prior: Prior, kept: float) -> Prior:
    """Return the prior with its covariance divided by its weight."""
    scale = 1 / np.sqrt(prior_weight(kept))
    return prior.widened(np.full(len(prior.mean), scale))


def relaxed_prior(prior: Prior, parameters: ParameterSet, link: str) -> Prior:
    """Return the prior of a robot that something of unknown mass and place was added to at a link.

    What is added has zero mean and the deviations of :func:`payload_std`.
    """
    start = 10 * parameters.link_names.index(link)
    added = np.zeros(len(prior.mean))
    added[start : start + 10] = payload_std(parameters, prior.mean)[start // 10]
    std = np.hypot(prior.std, added)
    if prior.factor is None:
        return replace(prior, std=std)
    covariance = prior.factor @ prior.factor.T + np.diag(added**2)
    scaled = np.linalg.cholesky(covariance / np.outer(std, std))
    factor = std[:, None] * scaled
    return replace(prior, std=np.linalg.norm(factor, axis=1), factor=factor)


def discounted_pseudo_measurements(
    known: PseudoMeasurements | None, kept: float
) -> PseudoMeasurements | None:
    """Return other knowledge with the same weight: a robot that was weighed may carry more now."""
    if known is None:
        return None
    root = np.sqrt(prior_weight(kept))
    return PseudoMeasurements(root * known.rows, root * known.targets)
