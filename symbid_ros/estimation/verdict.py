"""Verdict on an estimate: what the log determined, and alarms that warn against trusting it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.estimation.directions import determined_directions
from symbid_ros.estimation.mass_scale import weighing_residual
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements
from symbid_ros.estimation.unexplained import SMALL, UnexplainedForce
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_drift import final_drifts

# A parameter or direction is determined if the data say more about it than the prior, which halves
# the variance. This is the largest ratio of standard deviations.
DETERMINED = 1 / np.sqrt(2)

# Largest factor on the prior's deviations by evidence. Above it, prior, kinematics or sensors are
# wrong. A factor below 1 is harmless, as the prior is then only too wide.
SUSPICIOUS_SCALE = 2.0
# The same for a model file's values, whose ±25 % are a guess. A zero that is a centre of mass on an
# axis gets a small deviation, so a correct log of a body with one widens it up to ten times.
SUSPICIOUS_MODEL_SCALE = 20.0
# Largest whiteness of residuals that count as white noise.
SUSPICIOUS_WHITENESS = 1.4
# Growth of the residuals by constraints. It is at most 1.07 in logs of eleven real robots.
SUSPICIOUS_GROWTH = 1.4
# Deviations of its prior by which an encoder's zero may be found wrong.
SUSPICIOUS_ZERO = 5.0
# Largest share of a direction's apparent information that may be noise in the regressor.
SUSPICIOUS_NOISE = 0.5

# What the alarm about factors of efforts begins with.
WRONG_FACTORS = "the efforts have wrong factors"
NOTHING = (
    "the data determined nothing, and all numbers are those of the prior: record more motion, or "
    "name fewer joint terms, as Coulomb friction needs windows in which each joint slips"
)


@dataclass(frozen=True)
class EstimatedQuantity:
    """An estimated number with its uncertainty.

    Attributes
    ----------
    name, unit : str
    value, std : float
    determined : bool
        Whether the data say more about it than the prior.
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
        Factor on the stated deviations of the prior that makes the data most probable; on ±25 % if
        none are stated.
    whiteness : float
        Variance of the residual in long windows relative to white noise, see
        :func:`symbid_ros.estimation.observations.whiteness`; 0 if there was one window only.
    noise_share : float
        Largest share of a direction's apparent information that is noise in the regressor.
    alarms : tuple of str
        Reasons not to trust the estimate, one line each.
    effective : float
        Effective number of parameters that the data determine, Σ (1 - r²).
    gain : float
        Total information gain, bit.
    link_gain : dict of str to float
        Information gain per link, bit.
    directions : tuple of str
        Determined directions of parameter space, best first.
    base : tuple of EstimatedQuantity
        Base parameters: the combinations of parameters that affect forces.
    sensors : tuple of EstimatedQuantity
        Sensor errors that were identified together with the robot.
    unexplained : tuple of UnexplainedForce
        Of each coordinate, the largest share first; empty if there was one window only.
    is_prior_scaled : bool
        Whether that factor has been applied, because no deviations are stated.
    mass_scale : float
        Relative standard deviation of a scale that all masses share and the data cannot check; 0
        with a weighing.
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
    unexplained: tuple[UnexplainedForce, ...] = ()
    is_prior_scaled: bool = False
    mass_scale: float = 0.0

    @property
    def is_coloured(self) -> bool:
        """Whether residuals raise an alarm: correlated in time, and not small."""
        return is_coloured(self.whiteness, self.unexplained)

    @property
    def largest_prior_scale(self) -> float:
        """Largest factor on the prior's deviations that raises no alarm."""
        return SUSPICIOUS_MODEL_SCALE if self.is_prior_scaled else SUSPICIOUS_SCALE

    def describe_drift(self) -> str:
        """Return which sensor error changed most clearly during the log; empty if none drifts."""
        changes = final_drifts([one.name for one in self.sensors])
        if not changes:
            return ""
        error, place = max(
            changes.items(),
            key=lambda each: abs(self.sensors[each[1]].value) / self.sensors[each[1]].std,
        )
        start = next(one for one in self.sensors if one.name == error)
        change = self.sensors[place]
        return (
            f"{len(changes)} sensor errors drift, {error} most clearly: {start.value:.3g} ± "
            f"{start.std:.2g} {start.unit} at the start, {change.value:+.3g} ± {change.std:.2g} "
            f"{change.unit} until the end"
        )

    def describe_drive_gains(self) -> str:
        """Return the factors from readings to efforts of drives; empty if none is identified."""
        gains = [
            f"{joint} {one.value:.4g} ± {one.std:.2g}"
            for one in self.sensors
            for joint, _, kind in [one.name.rpartition("/")]
            if kind == "drive_gain"
        ]
        return f"drive gains: {', '.join(gains)}" if gains else ""

    def describe_payload_places(self) -> tuple[str, ...]:
        """Return the places of payloads that were not given, a line each."""
        places: dict[str, list[str]] = {}
        for one in self.sensors:
            name, _, kind = one.name.rpartition("/")
            if kind.startswith("payload_place"):
                places.setdefault(name, []).append(f"{1e3 * one.value:.1f} ± {1e3 * one.std:.2g}")
        named = ((*name.partition("kg_on_"), at) for name, at in places.items())
        return tuple(
            f"payload of {mass} kg on {frame}: centre of mass at ({', '.join(at)}) mm in its axes"
            for mass, _, frame, at in named
        )

    def describe_mass_scale(self, *, floating: bool = True) -> str:
        """Return what the data cannot check about the masses; empty with a weighing.

        Beside drive gains another line says where the scale comes from. The efforts of a robot with
        a fixed base do not carry all of it, so that its total mass tells nothing about them.
        """
        if self.mass_scale == 0 or self.describe_drive_gains():
            return ""
        start = f"mass scale ± {100 * self.mass_scale:.2g} %, not checkable"
        if not floating:
            return (
                f"{start} by efforts that have a gain in common: give the deviation of that gain "
                "as `force_scale_std`"
            )
        return (
            f"{start} without a weighing: give `total_mass`, or the deviation of the sensors' "
            "common gain as `force_scale_std`"
        )


def is_coloured(whiteness: float, unexplained: Sequence[UnexplainedForce]) -> bool:
    """Return whether residuals are correlated in time and not small against the forces.

    Their size is unknown if ``unexplained`` is empty.
    """
    is_large = not unexplained or unexplained[0].share > SMALL
    return whiteness > SUSPICIOUS_WHITENESS and is_large


def assess(
    posterior: Posterior,
    value: FloatArray,
    parameters: ParameterSet,
    *,
    window: float,
    whiteness: float,
    sensors: tuple[Sequence[str], Sequence[str]] = ((), ()),
    unexplained: tuple[UnexplainedForce, ...] = (),
    measurements: PseudoMeasurements | None = None,
    mass_scale: float = 0.0,
    rows: float = np.inf,
) -> Verdict:
    """Return the verdict on an estimate.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the robot's p parameters and r sensor errors.
    value : (p + r,) float64
        The estimate, which may differ from the posterior's mean.
    parameters : ParameterSet
        The robot's columns.
    window, whiteness, unexplained
        See :class:`Verdict`.
    sensors : pair of sequences of str
        Names and units of the sensor errors.
    measurements : PseudoMeasurements or None
        Those of the posterior.
    mass_scale : float
        See :class:`Verdict`.
    rows : float
        Number of rows of all coordinates.
    """
    p = len(parameters)
    prior, factor = posterior.prior_factor, posterior.deviation_factor
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
        prior_scale=posterior.prior_scale * posterior.chosen_scale,
        whiteness=whiteness,
        noise_share=posterior.noise_share,
        alarms=(
            *(() if count else (NOTHING,)),
            *alarms(posterior, whiteness, unexplained, measurements),
            *_contradicted_limits(posterior, value, rows),
            *_large_offsets(posterior, sensors, value, p),
        ),
        effective=known.effective,
        gain=known.gain,
        link_gain=known.link_gain,
        directions=tuple(known.describe(i) for i in range(count)),
        base=base,
        sensors=errors,
        unexplained=unexplained,
        is_prior_scaled=posterior.is_scaled,
        mass_scale=mass_scale,
    )


def _square(factor: FloatArray) -> FloatArray:
    """Return a square factor (p, p) of the covariance that a factor with p rows has."""
    if factor.shape[0] == factor.shape[1]:
        return factor
    triangle = np.asarray(np.linalg.qr(factor.T, mode="r"), dtype=np.float64)
    return triangle.T


def alarms(
    posterior: Posterior,
    whiteness: float,
    unexplained: Sequence[UnexplainedForce] = (),
    measurements: PseudoMeasurements | None = None,
) -> tuple[str, ...]:
    """Return the alarms of an estimate, one line each; arguments as in :func:`assess`."""
    found = []
    if posterior.chosen_scale > SUSPICIOUS_MODEL_SCALE:
        found.append(
            f"the data widened the prior of the inertias {posterior.chosen_scale:.1f} times, from "
            f"±25 % to ±{25 * posterior.chosen_scale:.0f} % of the model's values: the model lacks "
            "a tool or payload, or its inertias, its kinematics, a sensor's gain or calibration is "
            "wrong"
        )
    if posterior.prior_scale > SUSPICIOUS_SCALE:
        found.append(
            f"the data contradict the prior, which would have to be {posterior.prior_scale:.1f} "
            "times wider: the prior, the kinematics or a sensor's calibration is wrong"
        )
    if is_coloured(whiteness, unexplained):
        found.append(coloured_alarm(whiteness, unexplained))
    if posterior.noise_share > SUSPICIOUS_NOISE:
        found.append(
            f"{100 * posterior.noise_share:.0f} % of the information about one direction is noise "
            "in the motion: move more, or use longer windows"
        )
    weighing = weighing_residual(posterior, measurements)
    if weighing is not None and weighing.is_contradiction:
        found.append(
            f"the weighing of {weighing.weighed:.2f} ± {weighing.weighed_std:.2g} kg contradicts "
            f"the data, which say {weighing.implied:.2f} ± {weighing.implied_std:.2g} kg "
            f"({abs(weighing.deviations):.0f} standard deviations): the weighing or a gain of the "
            "forces is wrong, or a support without a sensor carries weight"
        )
    return tuple(found)


def _contradicted_limits(posterior: Posterior, value: FloatArray, rows: float) -> tuple[str, ...]:
    """Return the alarm that possible links and drives hardly explain what others do explain."""
    if rows < 1:
        return ()
    moved = posterior.factor @ (value - posterior.mean)
    growth = float(np.sqrt(1.0 + moved @ moved / rows))
    if growth < SUSPICIOUS_GROWTH:
        return ()
    return (
        "the data contradict links that are physically possible and drives that take power: with "
        f"these the residuals are {growth:.1f} times as large as without; signs, units or zeros of "
        "joints, or the kinematics are wrong",
    )


def _large_offsets(
    posterior: Posterior,
    sensors: tuple[Sequence[str], Sequence[str]],
    value: FloatArray,
    first: int,
) -> tuple[str, ...]:
    """Return the alarm about zeros of encoders that err by far more than their prior states.

    Gravity hardly tells such an error from other first moments of the links, so that the prior
    holds it back, and the links take the rest.
    """
    deviations = (value - posterior.prior.mean) / posterior.prior.std
    found = [
        f"{name.rpartition('/')[0]} ({value[index]:.3g} {unit}, {abs(deviations[index]):.0f} times "
        "what is assumed)"
        for index, (name, unit) in enumerate(zip(*sensors, strict=True), first)
        if name.endswith("/encoder_offset") and abs(deviations[index]) > SUSPICIOUS_ZERO
    ]
    if not found:
        return ()
    return (
        f"encoder offsets are too large to be estimated well: {', '.join(found)}; the true ones "
        "are probably larger, and first moments of links take the rest: correct the joints' zeros "
        "in the driver",
    )


def coloured_alarm(
    whiteness: float, unexplained: Sequence[UnexplainedForce], *, when: str = "", cause: str = ""
) -> str:
    """Return the alarm of residuals that are correlated in time.

    Parameters
    ----------
    whiteness, unexplained
        See :class:`Verdict`.
    when : str
        When most of the force is unexplained, if that is known.
    cause : str
        What explains it, and what to do, if causes were tried.
    """
    size = f"{unexplained[0]}{when and f', mostly {when}'}: " if unexplained else ""
    cause = cause or (
        "the model lacks an effect or a sensor's calibration is wrong; identify a bag to have "
        "likely causes tried"
    )
    return f"{size}the residuals are not white noise (whiteness {whiteness:.1f}); {cause}"
