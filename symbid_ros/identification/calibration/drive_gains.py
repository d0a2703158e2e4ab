"""Efforts in unknown units, such as motor currents: one signed factor for each joint.

First the sign and the size of each factor are found joint by joint: the measured values are
explained by the torque that the prior needs, viscous and Coulomb friction and an offset, once for
either sign. Torque and friction must then have the same sign, because friction dissipates power.
:mod:`symbid_ros.identification.calibration.extended_problem` identifies the factors together with
all parameters.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.friction import coulomb_column
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.errors import OptionError
from symbid_ros.estimation.observations import Observations
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sampled_rows import MOST_AT_ONCE, RowBuilder, SampledRows
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import ALL_WINDOWS, suitable_windows, windowed_rows

logger = logging.getLogger(__name__)

# Share by which the better sign must reduce the square error.
DECIDED = 0.1
# Standard deviation of a factor of unknown unit, relative to its first guess.
SPREAD = 1.0
# Weight of calibrated joints in the common factor, as the share of a joint's effort that the links
# explain: they decide where these explain next to nothing.
CALIBRATED = 0.1
# Number of joints whose efforts the links must explain for first guesses of a common scale.
LEAST_EXPLAINED = 1.0
# Combinations of loads and offsets of wrist sensors that change the readings by less than this
# share of others are left as they are.
LEAST_SHOWN = 1e-3


@dataclass(frozen=True)
class InitialFactors:
    """First guesses of the factors.

    Attributes
    ----------
    joints : tuple of str
        Joints with unknown factors.
    values : (J,) float64
        Nm or N per unit of the measured effort, of all joints; 1 where it is known.
    weights : (k,) float64
        Share that each of ``joints`` has in the common scale: that of its squared effort which the
        links explain.
    unsigned : tuple of str
        Those whose sign the log does not show; it is taken as positive.
    tell_scale : bool
        Whether the guesses determine the common scale. They do not if other joints are calibrated
        and the links explain next to nothing of these efforts, or if the prior holds it.
    spread : float
        Standard deviation of a factor, relative to its first guess.
    """

    joints: tuple[str, ...]
    values: FloatArray
    weights: FloatArray
    unsigned: tuple[str, ...] = ()
    tell_scale: bool = True
    spread: float = SPREAD

    @classmethod
    def near_one(cls, joints: tuple[str, ...], count: int, spread: float) -> "InitialFactors":
        """Return factors of efforts in Nm or N of some of ``count`` joints, whose prior is 1."""
        weights = np.full(len(joints), 1 / len(joints))
        return cls(joints, np.ones(count), weights, tell_scale=False, spread=spread)

    def report(self, source: str) -> None:
        """Warn about joints of a log whose sign is not known."""
        if self.unsigned:
            logger.warning(
                "%s: the log does not show the sign of the effort of %s, which is taken as "
                "positive; move the joint more, or leave it out of `drive_gain`",
                source,
                ", ".join(self.unsigned),
            )


@dataclass(frozen=True)
class ConvertedSegments:
    """Segments with efforts in Nm and N; factors (J,) are torques or forces per measured unit."""

    segments: Iterable[Segment]
    factors: FloatArray

    def __iter__(self) -> Iterator[Segment]:
        for one in self.segments:
            yield replace(one, effort=self.factors * one.effort)


def named_joints(names: Sequence[str], model: RobotModel) -> tuple[str, ...]:
    """Return the joints that ``names`` mean, which may be ``all``.

    Raises
    ------
    OptionError
        When the model has no such joint, or it is passive.
    """
    driven = [joint.name for joint in model.joints if joint.effort > 0 and joint.mimic is None]
    if list(names) == ["all"]:
        return tuple(driven)
    for name in names:
        if name not in driven:
            raise OptionError(
                f"`drive_gain`: {model.source} has no driven joint {name!r}; give all, or some of "
                f"{', '.join(driven)}",
                "E501",
            )
    return tuple(name for name in driven if name in names)


def with_measured_loads(
    phi: FloatArray, observations: Observations, parameters: ParameterSet
) -> FloatArray:
    """Return parameters in which wrist sensors have weighed the bodies beyond them.

    The model file may lack a tool, whose weight the drives carry nevertheless. ``phi`` (p,) is the
    prior's mean. Rows of wrist sensors contain no effort of a drive.
    """
    model, layout = parameters.model, observations.layout
    moment = np.zeros((len(phi) + 1, len(phi) + 1))
    for place in model.wrist_sensors.values():
        for coordinate in range(place.start, place.stop):
            row = 6 * model.floating + coordinate
            used = np.append(layout.columns[row], len(phi))
            factor = observations.rows.coordinate_factors[row]
            moment[np.ix_(used, used)] += factor.T @ factor
    size = np.sqrt(moment.diagonal()[:-1])
    shown = size > 0
    size = size[shown]
    K = moment[:-1, :-1][np.ix_(shown, shown)] / np.outer(size, size)
    y = (moment[:-1, -1] - moment[:-1, :-1] @ phi)[shown] / size
    found = phi.copy()
    found[shown] += np.linalg.pinv(K, rcond=LEAST_SHOWN**2, hermitian=True) @ y / size
    return found


def initial_factors(
    segments: Iterable[Segment], parameters: ParameterSet, phi: FloatArray, joints: tuple[str, ...]
) -> InitialFactors:
    """Return sign and size of the unknown factors of ``joints`` from a log.

    ``phi`` (p,) is the prior's mean, with the loads that wrist sensors measure.
    """
    model = parameters.model
    moments = np.zeros((len(model.joints), 5, 5))
    for segment in segments:
        window = suitable_windows(ALL_WINDOWS, segment.rate)[-1:]
        for (rows,) in windowed_rows(segment, _explaining(parameters, phi), window, ()):
            used = rows.valid[:, -len(model.joints) :]
            table = np.concatenate([rows.mean.K, rows.mean.y[:, :, None]], axis=2) * used[..., None]
            moments += np.einsum("tja,tjb->jab", table, table)
    found = {joint: _factor(moments[model.joint_names.index(joint)]) for joint in joints}
    weights = np.array([one.explained for one in found.values()])
    sizes = np.log([one.size for one in found.values()])
    has_calibrated = len(joints) < len(named_joints(("all",), model))
    total = weights.sum() + CALIBRATED * has_calibrated
    common = weights @ sizes / total if total else 0.0  # the logarithm of a calibrated one is zero
    # Torque that the links do not explain makes the logarithm of a factor uncertain by about
    # √((1 - e)/e). Those of one robot differ by about one, so the best weights are e and 1 - e.
    guesses = np.exp(weights * sizes + (1 - weights) * common)
    values = np.ones(len(model.joints))
    for (joint, one), guess in zip(found.items(), guesses, strict=True):
        values[model.joint_names.index(joint)] = one.sign * guess
    unsigned = tuple(joint for joint, one in found.items() if not one.is_certain)
    tell_scale = not has_calibrated or weights.sum() >= LEAST_EXPLAINED
    weights = weights if weights.any() else np.ones(len(joints))
    return InitialFactors(joints, values, weights / weights.sum(), unsigned, tell_scale)


def _explaining(parameters: ParameterSet, phi: FloatArray) -> RowBuilder:
    """Return a builder of rows [needed torque, q̇, sign q̇, 1] and the measured effort."""
    # Friction has columns of its own: that of the model file may be a placeholder.
    bare = ParameterSet(
        parameters.model, link_side=parameters.link_side, payloads=parameters.payloads
    ).with_known_values({})
    first = 6 * parameters.model.floating

    def build(readings: SensorSamples) -> Iterator[SampledRows]:
        for start in range(0, len(readings), MOST_AT_ONCE):
            samples = at_base(readings[start : start + MOST_AT_ONCE], bare.model)
            measured = samples.effort
            still = replace(samples, effort=np.zeros_like(measured))
            rows = equation_of_motion(bare, still)
            links = np.zeros(len(bare))
            links[: bare.inertial] = phi[: bare.inertial]
            needed = (rows.K @ links - rows.y)[:, first:]
            velocity = samples.velocity
            columns = [
                needed,
                velocity,
                coulomb_column(velocity, bare.model.joints),
                np.ones_like(needed),
            ]
            valid: BoolArray = np.isfinite(measured)
            for payload in bare.payloads:
                if payload.frame is not None:  # the torque that it needs is not known yet
                    valid &= ~payload.is_carried(samples.stamp)[:, None]
            yield SampledRows(
                samples.stamp, Rows(np.stack(columns, axis=2), np.nan_to_num(measured)), valid
            )

    return build


@dataclass(frozen=True)
class _Factor:
    """Sign and size of a factor, and the share of the squared effort that the links explain."""

    sign: float
    size: float
    explained: float
    is_certain: bool


def _factor(moment: FloatArray) -> _Factor:
    """Return a joint's factor.

    The moment (5, 5) is that of needed torque, speed, sign of the speed, one, and measured effort.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - loads slowly, and is seldom needed

    size = np.sqrt(np.maximum(moment.diagonal(), 1e-300))
    values, V = np.linalg.eigh(moment / np.outer(size, size))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * V.T
    columns = np.column_stack([root[:, :4], -root[:, 3]])
    fits = {sign: nnls(columns, sign * root[:, 4]) for sign in (1.0, -1.0)}
    sign = min(fits, key=lambda one: fits[one][1])
    (solution, left), (_, other) = fits[sign], fits[-sign]
    is_certain = left**2 < (1 - DECIDED) * other**2
    if not is_certain:
        sign, solution = 1.0, fits[1.0][0]
    slope = solution[0] * size[4] / size[0]
    return _Factor(
        sign, 1 / max(slope, 1e-300), min(float(solution[0]) ** 2, 1.0), bool(is_certain)
    )
