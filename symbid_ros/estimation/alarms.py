"""Alarms: reasons not to trust an estimate, one line each."""

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.directions import count_determined
from symbid_ros.estimation.mass_scale import weighing_residual
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements
from symbid_ros.estimation.unexplained import UnexplainedForce

# Largest factor on the prior's deviations by evidence. Above it, prior, kinematics or sensors are
# wrong. A factor below 1 is harmless, as the prior is then only too wide.
SUSPICIOUS_SCALE = 2.0
# The same for a model file's values, whose ±25 % are a guess. A zero that is a centre of mass on an
# axis gets a small deviation, so a correct log of a body with one widens it up to ten times.
SUSPICIOUS_MODEL_SCALE = 20.0
# Ratio of a link's mass to the prior's, and deviations of the prior as the data widened it, from
# which the model lacks a body. Payloads of 2 to 3 kg beyond a wrist of .2 kg had ratios of 6 to 9
# and 2.4 to 15 deviations; links of correct logs change by up to half of their mass.
HEAVY, HEAVY_DEVIATIONS = 3.0, 2.0
# Largest whiteness of residuals that count as white noise.
SUSPICIOUS_WHITENESS = 1.4
# Growth of the residuals by constraints. It is at most 1.07 in logs of eleven real robots.
SUSPICIOUS_GROWTH = 1.4
# Deviations of its prior by which an encoder's zero may be found wrong.
SUSPICIOUS_ZERO = 5.0
# Largest share of a direction's apparent information that may be noise in the regressor.
SUSPICIOUS_NOISE = 0.5
# What a weighing shows that contradicts the data.
WRONG_MASS = (
    "the weighing or a gain of the forces is wrong, or a support without a sensor carries weight"
)
IMPOSSIBLE_MASS = (
    "no mass is negative, so the forces have the wrong sign, or the log does not tell the mass "
    "from errors of the model and constant torques of the joints: record more varied postures"
)


class Alarm(StrEnum):
    """A phrase that each alarm of one kind contains, also in files; docs/errors.md explains it."""

    NOTHING = "the data determined nothing"
    WIDENED_PRIOR = "the data widened the prior"
    PRIOR = "the data contradict the prior"
    HEAVY_LINK = "times as heavy as in the model"
    COLOURED = "the residuals are not white noise"
    NOISY_MOTION = "of the information about one parameter combination is noise"
    WEIGHING = "contradicts the data, which say"
    LIMITS = "physically possible links and drives do not explain the data"
    TOTAL_MASS = "the total mass went from"
    SOLES = "the poses of resting soles vary"
    LACKING_JOINTS = "the log lacks"
    LIFTED = "according to the flags,"
    READINGS = "the efforts contradict the readings of joints"
    MISSING_INERTIA = "show gravity but no inertia"
    UNPREDICTED_EFFORT = "the model does not predict the effort of"
    UNPREDICTED_END = "the first part of the log does not predict the last quarter"
    WRONG_FACTORS = "the efforts have wrong factors"
    UNCERTAIN_FACTORS = "physically possible links explain the efforts only with factors"
    WRIST_SENSOR = "times what the efforts of the joints imply"
    LARGE_OFFSETS = "encoder offsets are too large to be estimated well"
    RESTING_JOINT = "not move in this log, and the effort"
    UNJUDGED_FRICTION = "too little motion to judge the friction of"
    AT_REST = "no joint moves: the log shows the forces in one posture"


def is_coloured(whiteness: float, unexplained: Sequence[UnexplainedForce]) -> bool:
    """Return whether residuals are correlated in time and not small against the forces.

    Their size is unknown if ``unexplained`` is empty. A large part of one force is enough, as a
    coordinate with few rows, such as a joint of a leg that seldom swings, hardly adds to the
    whiteness.
    """
    is_large = not unexplained or not unexplained[0].is_small
    is_correlated = whiteness > SUSPICIOUS_WHITENESS and is_large
    return is_correlated or any(one.is_clearly_large for one in unexplained)


def alarms(
    posterior: Posterior,
    value: FloatArray,
    parameters: int,
    *,
    whiteness: float,
    unexplained: Sequence[UnexplainedForce] = (),
    measurements: PseudoMeasurements | None = None,
    rows: float = np.inf,
    sensors: tuple[Sequence[str], Sequence[str]] = ((), ()),
) -> tuple[str, ...]:
    """Return the alarms that an estimate and its data raise.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the robot's parameters and the sensor errors.
    value : (p + r,) float64
        The estimate, which may differ from the posterior's mean.
    parameters : int
        Number p of the robot's parameters.
    whiteness, unexplained
        See :class:`symbid_ros.estimation.verdict.Verdict`.
    measurements : PseudoMeasurements or None
        Those of the posterior.
    rows : float
        Number of rows of all coordinates.
    sensors : tuple of sequences of str
        Names and units of the sensor errors.
    """
    found = []
    if not count_determined(
        posterior.prior_factor[:parameters], posterior.deviation_factor[:parameters]
    ):
        found.append(
            f"{Alarm.NOTHING}, and all numbers are those of the prior: record more motion, or name "
            "fewer `joint_terms`, as Coulomb friction needs windows in which each joint moves"
        )
    if posterior.chosen_scale > SUSPICIOUS_MODEL_SCALE:
        found.append(
            f"{Alarm.WIDENED_PRIOR} of the inertias by a factor of {posterior.chosen_scale:.1f}, "
            f"from ±25 % to ±{25 * posterior.chosen_scale:.0f} % of the model's values: the model "
            "lacks a tool or payload, or its inertias, its kinematics or the calibration of a "
            "sensor are wrong"
        )
    if posterior.prior_scale > SUSPICIOUS_SCALE:
        found.append(
            f"{Alarm.PRIOR}, which would have to be {posterior.prior_scale:.1f} "
            "times wider: the prior, the kinematics or a sensor's calibration is wrong"
        )
    weighing = weighing_residual(posterior, measurements)
    if weighing is not None and weighing.is_contradiction:
        found.append(
            f"the weighing of {weighing.weighed:.2f} ± {weighing.weighed_std:.2g} kg "
            f"{Alarm.WEIGHING} {weighing.implied:.2f} ± {weighing.implied_std:.2g} kg "
            f"({abs(weighing.deviations):.0f} standard deviations): "
            f"{IMPOSSIBLE_MASS if weighing.implied < 0 else WRONG_MASS}"
        )
    if is_coloured(whiteness, unexplained):
        found.append(coloured_alarm(whiteness, unexplained))
    if posterior.noise_share > SUSPICIOUS_NOISE:
        found.append(
            f"{100 * posterior.noise_share:.0f} % {Alarm.NOISY_MOTION} of the motion sensors: "
            "move more, or use longer windows"
        )
    found += _contradicted_limits(posterior, value, rows)
    found += _large_offsets(posterior, sensors, value, parameters)
    return tuple(found)


def heavy_link_alarms(
    links: Sequence[str], before: FloatArray, after: FloatArray, std: FloatArray
) -> tuple[str, ...]:
    """Return the alarm that links weigh far more than their prior allows.

    Parameters
    ----------
    links : sequence of str
    before, after : (k,) float64
        Masses of the prior and of the estimate, kg.
    std : (k,) float64
        Deviations of the former, as the data widened them, kg.
    """
    is_heavy = (after > HEAVY * before) & (after - before > HEAVY_DEVIATIONS * std) & (before > 0)
    # If most links are heavy, the unit of efforts or masses is wrong.
    if not 0 < 2 * np.count_nonzero(is_heavy) <= len(links):
        return ()
    heavy = [
        f"{links[index]} is {after[index] / before[index]:.2g} {Alarm.HEAVY_LINK} "
        f"({before[index]:.3g} kg)"
        for index in np.flatnonzero(is_heavy).tolist()
    ]
    return (
        f"{', '.join(heavy)}: is a tool or payload missing there, or is the model's mass a "
        "placeholder? Correct the model, as a log may determine only a part of what is missing",
    )


def _contradicted_limits(posterior: Posterior, value: FloatArray, rows: float) -> tuple[str, ...]:
    """Return the alarm that possible links and drives hardly explain what others do explain."""
    if rows < 1:
        return ()
    moved = posterior.factor @ (value - posterior.mean)
    growth = float(np.sqrt(1.0 + moved @ moved / rows))
    if growth < SUSPICIOUS_GROWTH:
        return ()
    return (
        f"{Alarm.LIMITS}: with these constraints the residuals are {growth:.1f} times as large "
        "as without; signs, units or zeros of joints, or the kinematics, are wrong",
    )


def _large_offsets(
    posterior: Posterior,
    sensors: tuple[Sequence[str], Sequence[str]],
    value: FloatArray,
    first: int,
) -> tuple[str, ...]:
    """Return the alarm about zeros of encoders that err by far more than their prior states.

    Gravity hardly separates such an error from first moments of the links. So the prior holds it
    back, and the links take the rest.
    """
    deviations = (value - posterior.prior.mean) / posterior.prior.std
    found = [
        f"{name.rpartition('/')[0]} ({value[index]:.3g} {unit}, {abs(deviations[index]):.0f} times "
        "the assumed standard deviation)"
        for index, (name, unit) in enumerate(zip(*sensors, strict=True), first)
        if name.endswith("/encoder_offset") and abs(deviations[index]) > SUSPICIOUS_ZERO
    ]
    if not found:
        return ()
    return (
        f"{Alarm.LARGE_OFFSETS}: {', '.join(found)}; the true ones are probably larger, and "
        "the first moments of links are then wrong: correct the zeros of these joints in the "
        "driver",
    )


def coloured_alarm(
    whiteness: float, unexplained: Sequence[UnexplainedForce], *, when: str = "", cause: str = ""
) -> str:
    """Return the alarm of residuals that are correlated in time.

    Parameters
    ----------
    whiteness, unexplained
        See :class:`symbid_ros.estimation.verdict.Verdict`.
    when : str
        When most of the force is unexplained, if that is known.
    cause : str
        What explains it, and what to do, if causes were tried.
    """
    size = f"{unexplained[0]}{when and f', mostly {when}'}: " if unexplained else ""
    is_gross = any(one.is_gross for one in unexplained[:1])
    cause = cause or (
        "the sign, unit or zero of a sensor is wrong; check a bag with `symbid bag doctor`"
        if is_gross
        else "the model lacks an effect or a sensor's calibration is wrong; record a bag, for "
        "which `symbid identify` names the likely cause"
    )
    # Single forces with few rows do not show in the whiteness.
    figure = f" (whiteness {whiteness:.1f})" if whiteness > SUSPICIOUS_WHITENESS else ""
    return f"{size}{Alarm.COLOURED}{figure}; {cause}"
