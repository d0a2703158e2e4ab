"""What a log could and could not tell, in words and numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.estimation.directions import determined_directions
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.model.parameters import ParameterSet

# A parameter, or a direction, is determined where the data say more of it than the prior did:
# where half the prior's variance is gone, and the ratio of standard deviations falls below this.
DETERMINED = 1 / np.sqrt(2)

# The evidence would have the prior this much wider: prior, kinematics or sensors are wrong. A prior
# that is more modest than need be harms nobody.
SUSPICIOUS_SCALE = 2.0
# Residuals that outlast noise by this much are no noise.
SUSPICIOUS_WHITENESS = 1.4
# Noise in the regressor was this much of what a direction seemed to be told.
SUSPICIOUS_NOISE = 0.5


@dataclass(frozen=True)
class EstimatedQuantity:
    """One number with its doubt.

    Attributes
    ----------
    name, unit : str
    value, std : float
    determined : bool
        Whether the data say more of it than was known before.
    """

    name: str
    unit: str
    value: float
    std: float
    determined: bool


@dataclass(frozen=True)
class Verdict:
    """How far an estimate can be trusted.

    Attributes
    ----------
    window : float
        Length of the rows' windows, s; 0 for filtered rows.
    prior_scale : float
        Factor on the prior's deviations under which the data are most probable.
    whiteness : float
        Variance that the residual keeps in long windows over what noise would, in the
        combination of coordinates where it keeps most; at most about 1 for noise, 0 where there
        was one window only.
    noise_share : float
        Largest share of a direction's apparent information that was noise in the regressor.
    alarms : tuple of str
        What is wrong, one line each.
    effective : float
        How many parameters' worth of knowledge the data brought, Σ (1 - r²).
    gain : float
        Information gained in all, bit.
    link_gain : dict of str to float
        The same per link, bit.
    directions : tuple of str
        The determined directions of parameter space, best first.
    base : tuple of EstimatedQuantity
        The combinations of parameters that forces can depend on.
    sensors : tuple of EstimatedQuantity
        Errors of the sensors that were identified along with the robot.
    """

    window: float
    prior_scale: float
    whiteness: float
    noise_share: float
    alarms: tuple[str, ...]
    effective: float
    gain: float
    link_gain: dict[str, float]
    directions: tuple[str, ...]
    base: tuple[EstimatedQuantity, ...]
    sensors: tuple[EstimatedQuantity, ...]


def assess(
    posterior: Posterior,
    value: FloatArray,
    parameters: ParameterSet,
    *,
    window: float,
    whiteness: float,
    sensors: tuple[Sequence[str], Sequence[str]] = ((), ()),
    has_wrenches: bool = True,
) -> Verdict:
    """Return the verdict on an estimate.

    Parameters
    ----------
    posterior : Posterior
        Of the robot's p parameters and r errors of its sensors.
    value : (p + r,) float64
        The estimate, which may differ from the posterior's mean.
    parameters : ParameterSet
        The robot's columns.
    window, whiteness : float
        As in :class:`Verdict`.
    sensors : pair of sequences of str
        Names and units of the sensors' errors.
    has_wrenches : bool
        Whether the robot has wrench sensors, which a tare could calibrate.
    """
    p = len(parameters)
    prior, factor = posterior.prior.covariance_factor(), posterior.deviation_factor
    known = determined_directions(
        _square(prior[:p]), _square(factor[:p]), parameters.names, DETERMINED
    )
    grouping = base_parameters(parameters)
    before = np.linalg.norm(grouping.matrix @ prior[:p], axis=1)
    after = np.linalg.norm(grouping.matrix @ factor[:p], axis=1)
    base = tuple(
        EstimatedQuantity(
            grouping.describe(i),
            grouping.units[grouping.independent[i]],
            float(grouping.matrix[i] @ value[:p]),
            float(after[i]),
            bool(after[i] < DETERMINED * before[i]),
        )
        for i in range(len(grouping))
    )
    errors = tuple(
        EstimatedQuantity(
            name,
            unit,
            float(value[p + i]),
            float(posterior.std[p + i]),
            bool(posterior.std[p + i] < DETERMINED * posterior.prior.std[p + i]),
        )
        for i, (name, unit) in enumerate(zip(*sensors, strict=True))
    )
    count = int(known.determined.sum())
    return Verdict(
        window=window,
        prior_scale=posterior.prior_scale,
        whiteness=whiteness,
        noise_share=posterior.noise_share,
        alarms=alarms(posterior, whiteness, has_wrenches=has_wrenches),
        effective=known.effective,
        gain=known.gain,
        link_gain=known.link_gain,
        directions=tuple(known.describe(i) for i in range(count)),
        base=base,
        sensors=errors,
    )


def _square(factor: FloatArray) -> FloatArray:
    """Return a square (p, p) factor of the same covariance as one of p rows."""
    if factor.shape[0] == factor.shape[1]:
        return factor
    triangle = np.asarray(np.linalg.qr(factor.T, mode="r"), dtype=np.float64)
    return triangle.T


def alarms(posterior: Posterior, whiteness: float, *, has_wrenches: bool = True) -> tuple[str, ...]:
    """Return what is wrong with an estimate, one line each; arguments as in :func:`assess`."""
    found = []
    if posterior.prior_scale > SUSPICIOUS_SCALE:
        found.append(
            f"the data would have the prior {posterior.prior_scale:.1f} times wider: the prior, "
            "the kinematics or a sensor's calibration is wrong"
        )
    if whiteness > SUSPICIOUS_WHITENESS:
        tare = "a tare, " if has_wrenches else ""
        found.append(
            f"residuals last longer than noise would (whiteness {whiteness:.1f}, at most 1 for "
            f"noise): the model or a sensor's calibration is wrong; identify {tare}sensor_errors "
            "typical or the joint terms that are missing (friction, armature, offset)"
        )
    if posterior.noise_share > SUSPICIOUS_NOISE:
        found.append(
            f"{100 * posterior.noise_share:.0f} % of what some direction seems to be told is noise "
            "in the motion: move more, or use longer windows"
        )
    return tuple(found)
