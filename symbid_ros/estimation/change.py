"""Parameters that change: detection of a changed link, and discounting of the prior.

Let A and b be whitened new rows and φ ~ N(φ̂, P) the posterior of earlier rows. Without a change
the innovation e = b - A φ̂ has covariance C = 1 + A P Aᵀ. A change δ of link l adds A E_l δ.
With δ ~ N(0, S) the log-likelihood ratio, the evidence for the change, is
½ gᵀ H⁻¹ g - ½ log det H, where M = C^(-1/2) A E_l S^(1/2), H = 1 + Mᵀ M and g = Mᵀ C^(-1/2) e
(Willsky and Jones 1976, IEEE Trans. Automatic Control 21(1), with the size integrated out).

When old rows are discounted, the prior must be discounted too. With its full weight it would in
the end determine every parameter that has changed. Its weight has a lower bound, so that
directions without data stay at the prior. The prior of a changed link is relaxed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.prior_std import payload_std
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import WindowedRows

# Difference in log-likelihood, nat, above which a change is attributed to one of two links. A mass
# on a hinge's axis moves alike with both of its links. Their evidence then differs only by the
# assumed distribution of payloads.
DISTINGUISHABLE = 10.0

# Lower bound on the prior's weight: its standard deviations at most double.
LEAST_WEIGHT = 0.25
# Weight of the data from before a change in the prior of the estimate that starts anew. An error of
# the model that is constant in one posture is not in the deviations, and a new posture reveals it.
LEARNED_WEIGHT = 0.25

# A sensor's error changes by this many typical errors: a plate that was hit or an amplifier that
# was set to zero.
SENSOR_CHANGE = 5.0


@dataclass(frozen=True)
class SensorHypothesis:
    """An error of one sensor that may have changed.

    Attributes
    ----------
    subject : str
        ``<sensor>/<kind of error>``.
    names, units : tuple of str
        Of its k components; names are those of the unknowns.
    std : (k,) float64
        Deviations of a change.
    """

    subject: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    std: FloatArray


@dataclass(frozen=True)
class SensorChange:
    """Estimated change of one sensor's error, under the hypothesis that only it has changed.

    Attributes
    ----------
    sensor : SensorHypothesis
    evidence, fit : float
        As of :class:`LinkChange`, nat.
    error : (k,) float64
        Change of the components.
    std : (k,) float64
        Standard deviations of the change.
    """

    sensor: SensorHypothesis
    evidence: float
    fit: float
    error: FloatArray
    std: FloatArray

    @property
    def subject(self) -> str:
        """``<sensor>/<kind of error>``."""
        return self.sensor.subject


@dataclass(frozen=True)
class LinkChange:
    """Estimated change of one link, under the hypothesis that only this link has changed.

    Attributes
    ----------
    link : str
        Name of the link.
    evidence : float
        Log-likelihood ratio of this hypothesis to no change, nat.
    fit : float
        Log-likelihood gain at the change's most probable size, nat, without its distribution.
    phi : (10,) float64
        Change of the link's parameters, about its origin.
    std : (10,) float64
        Standard deviations of the change.
    """

    link: str
    evidence: float
    fit: float
    phi: FloatArray
    std: FloatArray

    @property
    def subject(self) -> str:
        """Name of the link."""
        return self.link


@dataclass(frozen=True)
class Innovation:
    """Innovation of new rows relative to the posterior of earlier ones.

    Attributes
    ----------
    misfit : float
        Mean square of the normalised innovation, 1 without a change.
    changes : tuple of LinkChange or SensorChange
        One hypothesis for each link and sensor error, largest evidence first.
    """

    misfit: float
    changes: tuple[LinkChange | SensorChange, ...]

    def suspects(self, usual: float = 1.0) -> tuple[LinkChange | SensorChange, ...]:
        """Return the changes that explain the new rows about as well as the best one, best first.

        Parameters
        ----------
        usual : float
            Misfit of rows without a change, by which log-likelihoods are too large.
        """
        least = self.changes[0].fit - DISTINGUISHABLE * usual
        return tuple(change for change in self.changes if change.fit >= least)


def innovation(
    earlier: Posterior,
    recent: Sequence[WindowedRows],
    parameters: ParameterSet,
    sensors: Sequence[SensorHypothesis] = (),
) -> Innovation:
    """Compare new rows with the prediction from earlier rows.

    Parameters
    ----------
    earlier : Posterior
        Posterior of the earlier rows, over windows of the same length. Its residual covariance
        includes the factor for overlapping windows, and so does the misfit.
    recent : sequence of WindowedRows
        New rows, at least one.
    parameters : ParameterSet
        The robot's columns of the rows, of which the posterior may lack joint terms.
    sensors : sequence of SensorHypothesis
        Sensor errors, whose columns follow in this order.
    """
    names = [*parameters.names, *(name for sensor in sensors for name in sensor.names)]
    place = {name: index for index, name in enumerate(names)}
    kept = [place[name] for name in earlier.prior.names]
    count = len(kept)
    root = cholesky(earlier.covariance, lower=True)
    whitening = np.asarray(np.linalg.inv(root), dtype=np.float64)
    factor = _whitened_factor(recent, whitening, kept)
    A, b = factor[:count, :count], factor[:count, count]
    spread = A @ earlier.deviation_factor
    # QR of both terms: their sum loses the 1 where a relaxed prior makes the other one huge.
    both = np.concatenate([spread.T, np.eye(count)])
    root = np.asarray(np.linalg.qr(both, mode="r"), dtype=np.float64).T
    unexpected = solve_triangular(root, b - A @ earlier.mean, lower=True)
    response = solve_triangular(root, A, lower=True)

    def likely(columns: slice, scale: FloatArray) -> tuple[float, float, FloatArray, FloatArray]:
        """Return evidence, fit, size and deviations of a change of some unknowns."""
        M = response[:, columns] * scale
        H = np.eye(len(scale)) + M.T @ M
        g = M.T @ unexpected
        delta = np.linalg.solve(H, g)
        return (
            float(g @ delta - np.linalg.slogdet(H)[1]) / 2,
            float(g @ delta - np.sum((M @ delta) ** 2) / 2),
            scale * delta,
            scale * np.sqrt(np.linalg.inv(H).diagonal()),
        )

    changes: list[LinkChange | SensorChange] = [
        LinkChange(link, *likely(slice(10 * index, 10 * index + 10), scale))
        for index, (link, scale) in enumerate(
            zip(parameters.link_names, payload_std(parameters, earlier.prior.mean), strict=True)
        )
    ]
    start = count - sum(len(sensor.names) for sensor in sensors)
    for sensor in sensors:
        columns = slice(start, start := start + len(sensor.names))
        changes.append(SensorChange(sensor, *likely(columns, sensor.std)))
    return Innovation(
        misfit=float(unexpected @ unexpected) / count,
        changes=tuple(sorted(changes, key=lambda change: -change.evidence)),
    )


def _whitened_factor(
    recent: Sequence[WindowedRows], whitening: FloatArray, kept: Sequence[int]
) -> FloatArray:
    """Return the triangular factor (q + 1, q + 1) of all rows G [K y] with some columns of K."""
    flat = [
        np.concatenate([part.mean.K[:, :, kept], part.mean.y[:, :, None]], axis=2)
        for part in recent
    ]
    rows = whitening @ np.concatenate(flat)
    return stacked_factor(rows.reshape(-1, rows.shape[2]))


def prior_weight(kept: float) -> float:
    """Return the prior's weight when the first rows' weight is ``kept``, both from 0 to 1."""
    return max(kept, LEAST_WEIGHT)


def discounted_prior(prior: Prior, kept: float) -> Prior:
    """Return the prior with its covariance divided by its weight."""
    scale = 1 / np.sqrt(prior_weight(kept))
    return prior.widened(np.full(len(prior.mean), scale))


def relaxed_prior(prior: Prior, parameters: ParameterSet, change: LinkChange) -> Prior:
    """Return the prior after a payload of unknown mass and place was added to a link.

    The payload's parameters have zero mean and the deviations of :func:`payload_std`, or what the
    change is estimated to be where that is more, as of a payload far from the link's frame.
    """
    index = parameters.link_names.index(change.link)
    added = np.zeros(len(prior.mean))
    usual = payload_std(parameters, prior.mean)[index]
    added[10 * index : 10 * index + 10] = np.maximum(usual, np.abs(change.phi))
    return _with_variance(prior, added)


def relaxed_sensor_prior(prior: Prior, sensor: SensorHypothesis) -> Prior:
    """Return the prior after a sensor's error changed by an unknown amount."""
    added = np.zeros(len(prior.mean))
    added[[prior.names.index(name) for name in sensor.names]] = sensor.std
    return _with_variance(prior, added)


def _with_variance(prior: Prior, added: FloatArray) -> Prior:
    """Return the prior of parameters to which independent ones with deviations (p,) are added."""
    std = np.hypot(prior.std, added)
    if prior.factor is None:
        return replace(prior, std=std)
    covariance = prior.factor @ prior.factor.T + np.diag(added**2)
    scaled = np.linalg.cholesky(covariance / np.outer(std, std))
    factor = std[:, None] * scaled
    return replace(prior, std=np.linalg.norm(factor, axis=1), factor=factor, alone=None)


def prior_after_change(
    before: Posterior, terms: Prior, parameters: ParameterSet, changes: Sequence[LinkChange]
) -> Prior:
    """Return the prior of a robot of which some links have changed.

    The other links are as they were known before the change, but with less weight of the data. The
    changed ones are relaxed as in :func:`relaxed_prior`. Joint terms are as before all rows.

    Parameters
    ----------
    before : Posterior
        From the rows before the change.
    terms : Prior
        Before all rows, of the same unknowns; that of the links is not used.
    parameters : ParameterSet
        Columns of both.
    changes : sequence of LinkChange
        Of the links that may have changed.
    """
    count = parameters.inertial
    others = terms.marginal(terms.names[count:])
    first = before.prior.marginal(before.prior.names[:count]).covariance_factor()
    # Deviations along directions that are independent in the prior, of which each has 1.
    U, std, _ = np.linalg.svd(
        solve_triangular(first, before.deviation_factor[:count], lower=True), full_matrices=False
    )
    learned = np.maximum(1.0 / std**2 - 1.0, 0.0)
    std = 1.0 / np.sqrt(1.0 + LEARNED_WEIGHT * learned)
    root = block_diag(first @ (U * std), others.covariance_factor())
    mean = np.concatenate([before.mean[:count], others.mean])
    prior = replace(terms, mean=mean, alone=None).with_root(root)
    for change in changes:
        prior = relaxed_prior(prior, parameters, change)
    return prior


def discounted_pseudo_measurements(
    measurements: PseudoMeasurements | None, kept: float
) -> PseudoMeasurements | None:
    """Return pseudo-measurements with the prior's weight, as a weighed robot may carry more now."""
    if measurements is None:
        return None
    root = np.sqrt(prior_weight(kept))
    return replace(measurements, rows=root * measurements.rows, targets=root * measurements.targets)
