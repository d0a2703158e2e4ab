"""Verdict on an estimate: what the log determined, and how far that can be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.alarms import (
    SUSPICIOUS_MODEL_SCALE,
    SUSPICIOUS_SCALE,
    Alarm,
    is_coloured,
)
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.estimation.directions import DETERMINED, determined_directions, square_factor
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.unexplained import UnexplainedForce
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_drift import final_drifts


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
        if a weighing checks it.
    weighing_std : float
        Standard deviation of the robot's weighing, kg; 0 without one.
    is_scale_stated : bool
        Whether the user stated the standard deviation of the sensors' common gain error.
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
    weighing_std: float = 0.0
    is_scale_stated: bool = False

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
        count = len(changes)
        which = "1 sensor error drifts" if count == 1 else f"{count} sensor errors drift"
        return (
            f"{which}, most clearly {error}: {start.value:.3g} ± {start.std:.2g} {start.unit} at "
            f"the start, a change of {change.value:+.3g} ± {change.std:.2g} {change.unit} by the "
            "end"
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

    @property
    def has_open_scale(self) -> bool:
        """Whether a scale of all masses is open: no weighing checks or contradicts it."""
        is_contradicted = any(Alarm.WEIGHING in alarm for alarm in self.alarms)
        return self.mass_scale > 0 and not is_contradicted

    def describe_mass_scale(self, *, floating: bool = True) -> str:
        """Return what the data cannot check about the masses; empty if a weighing does.

        Beside drive gains another line says where the scale comes from, and beside the alarm of a
        weighing that alarm does. The efforts of a robot with a fixed base do not carry all of it,
        so that its total mass does not check them.
        """
        if not self.has_open_scale or self.describe_drive_gains():
            return ""
        start = f"mass scale ± {100 * self.mass_scale:.2g} %, not checkable"
        stated = "it follows from `force_scale_std`"
        if not floating:
            give = "give the standard deviation of their common gain error as `force_scale_std`"
            return f"{start} by efforts alone: {stated if self.is_scale_stated else give}"
        if self.weighing_std > 0:
            return (
                f"{start} by a weighing with a standard deviation of {self.weighing_std:.2g} kg: "
                "weigh the robot more accurately, and give `total_mass_std`"
            )
        if self.is_scale_stated:
            return f"{start} without a weighing: {stated}; give `total_mass` to check it"
        return (
            f"{start} without a weighing: give `total_mass`, or the standard deviation of the "
            "sensors' common gain error as `force_scale_std`"
        )


def assess(
    posterior: Posterior,
    value: FloatArray,
    parameters: ParameterSet,
    *,
    window: float,
    whiteness: float,
    sensors: tuple[Sequence[str], Sequence[str]] = ((), ()),
    unexplained: tuple[UnexplainedForce, ...] = (),
    alarms: tuple[str, ...] = (),
    mass_scale: float = 0.0,
    weighing_std: float = 0.0,
    is_scale_stated: bool = False,
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
    alarms, mass_scale, weighing_std, is_scale_stated
        See :class:`Verdict`.
    """
    p = len(parameters)
    prior, factor = posterior.prior_factor, posterior.deviation_factor
    known = determined_directions(
        square_factor(prior[:p]), square_factor(factor[:p]), parameters.names, DETERMINED
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
        alarms=alarms,
        effective=known.effective,
        gain=known.gain,
        link_gain=known.link_gain,
        directions=tuple(known.describe(i) for i in range(count)),
        base=base,
        sensors=errors,
        unexplained=unexplained,
        is_prior_scaled=posterior.is_scaled,
        mass_scale=mass_scale,
        weighing_std=weighing_std,
        is_scale_stated=is_scale_stated,
    )
