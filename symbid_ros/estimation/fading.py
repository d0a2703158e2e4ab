"""What is known beforehand, fading with the oldest data.

Where old rows lose weight, a prior that kept all of its own would in the end hold every
parameter that has changed. Its variance grows as the first rows' weight falls, up to a bound:
directions that no data reach must stay where they were. A link that is known to have changed is
released from it.
"""

from dataclasses import replace

import numpy as np

from symbid_ros.estimation.deviation import payload_std
from symbid_ros.estimation.posterior import SoftRows
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet

# What is left at last of the prior's weight: two of its standard deviations become one.
LEAST_WEIGHT = 0.25


def faded_weight(kept: float) -> float:
    """Return the prior's weight where ``kept`` of the first rows' is left, both from 0 to 1."""
    return max(kept, LEAST_WEIGHT)


def faded_prior(prior: Prior, kept: float) -> Prior:
    """Return the prior with its covariance divided by its weight."""
    scale = 1 / np.sqrt(faded_weight(kept))
    return prior.widened(np.full(len(prior.mean), scale))


def released(prior: Prior, parameters: ParameterSet, link: str) -> Prior:
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


def faded_rows(known: SoftRows | None, kept: float) -> SoftRows | None:
    """Return other knowledge with the same weight: a robot that was weighed may carry more now."""
    if known is None:
        return None
    root = np.sqrt(faded_weight(kept))
    return SoftRows(root * known.rows, root * known.targets)
