"""Bounds on joint terms by which drives take power, and a test whether the efforts contradict them.

Friction and armature of a drive are positive, but an effort may contain more than a drive. A torque
sensor between gear and link does not feel the rotor. Its hysteresis, crosstalk between sensors and
a base that bends may show less inertia than that of the links, or friction that falls with speed.
Stribeck friction may be negative, as that of a joint whose friction rises with speed, but never by
more than Coulomb friction.
A likelihood-ratio test compares the best fits with and without positive signs. Only if the efforts
contradict these, armatures may be free. Friction as a whole must then take power: its curve over
speed, which viscous, Coulomb and Stribeck friction fit together, is positive at the speeds of the
log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import Term
from symbid_ros.dynamics.friction import COULOMB_SPEED, by_kind, stribeck_column
from symbid_ros.estimation.constraints import Bounds
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.physical_consistency import ConsistentSolution, consistent_minimum
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint

# Number of speeds at which a joint's friction must not be negative, and the largest of these in
# root mean squares of the speed, which a joint seldom exceeds.
SPEEDS, FASTEST = 4, 2.0
# Probability of efforts that contradict positive signs by chance.
CHANCE = 1e-4
# Share of a joint's effort (RMS) that a term of the wrong sign must contribute, and the least
# effort as a share of the largest. Less, in a log without noise, is an error of the simulator.
LEAST_SHARE, LEAST_EFFORT = 1e-3, 1e-2


def drive_bounds(parameters: ParameterSet, observations: Observations) -> Bounds | None:
    """Return the bounds on joint terms by which drives take power; None without joint terms.

    The speeds at which friction must not be negative are those of the observations.
    """
    if not parameters.terms:
        return None
    if parameters.signed_drives:
        curves = friction_bounds(parameters, _typical_speed(parameters, observations))
    else:
        curves = breakaway_bounds(parameters)
    return Bounds.nonnegative(parameters) + curves


def breakaway_bounds(parameters: ParameterSet) -> Bounds:
    """Return bounds by which the friction of each joint that begins to slip is not negative."""
    if "stribeck" not in parameters.term_columns:
        return _curve_bounds(parameters, [])
    joints = [parameters.model.joints[joint] for joint in parameters.joints.tolist()]
    start = stribeck_column(by_kind(COULOMB_SPEED, joints)[None], joints)[0]
    return _curve_bounds(
        parameters, [{"coulomb": np.ones(1), "stribeck": start[[k]]} for k in range(len(joints))]
    )


def friction_bounds(parameters: ParameterSet, speed: FloatArray) -> Bounds:
    """Return bounds by which the friction of each joint is not negative at its speeds.

    Where a joint hardly moves, viscous friction alone must not be negative. ``speed`` (J,) is the
    root mean square of the speed of each joint with terms, rad/s or m/s.
    """
    if not {"viscous", "coulomb"} <= parameters.term_columns.keys():
        return _curve_bounds(parameters, [])  # the bounds on single terms suffice
    joints = [parameters.model.joints[joint] for joint in parameters.joints.tolist()]
    fastest = (FASTEST * speed).tolist()
    return _curve_bounds(parameters, [_curve(*each) for each in zip(fastest, joints, strict=True)])


def _curve_bounds(parameters: ParameterSet, curves: Sequence[Mapping[Term, FloatArray]]) -> Bounds:
    """Return bounds by which friction is not negative.

    ``curves`` hold the columns (k,) of the terms of each joint, at speeds of its own.
    """
    columns = parameters.term_columns
    names, rows = [], [np.zeros((0, len(parameters)))]
    for place, (joint, curve) in enumerate(zip(parameters.joints, curves, strict=False)):
        row = np.zeros((max(map(len, curve.values())), len(parameters)))
        for term in columns.keys() & curve.keys():
            row[:, columns[term].start + place] = curve[term]
        rows.append(row)
        names += [f"friction of {parameters.model.joint_names[joint]}"] * len(row)
    matrix = np.concatenate(rows)
    return Bounds(tuple(names), matrix, np.zeros(len(matrix)), np.full(len(matrix), np.inf))


def _curve(fastest: float, joint: Joint) -> dict[Term, FloatArray]:
    """Return the columns (k,) of friction at k speeds up to the fastest."""
    slowest = float(by_kind(COULOMB_SPEED, [joint])[0])
    if fastest <= slowest:
        return {"viscous": np.ones(1)}
    speed = np.geomspace(slowest, fastest, SPEEDS)
    stribeck = stribeck_column(speed[:, None], [joint])[:, 0]
    return {"viscous": speed, "coulomb": np.ones(SPEEDS), "stribeck": stribeck}


def _typical_speed(parameters: ParameterSet, observations: Observations) -> FloatArray:
    """Return the root mean square (J,) of the speed of each joint with terms."""
    columns = parameters.term_columns.get("viscous")
    if columns is None:
        return np.zeros(len(parameters.joints))
    return _column_rms(columns, parameters, observations)


def _column_rms(columns: slice, parameters: ParameterSet, observations: Observations) -> FloatArray:
    """Return the root mean square (J,) of a term's column in the rows of each joint."""
    rows_of = (6 * parameters.model.floating + parameters.joints).tolist()
    places = zip(rows_of, range(columns.start, columns.stop), strict=True)
    squares = [observations.rows.column_squares(row, column) for row, column in places]
    count = np.maximum(observations.counts.diagonal()[rows_of], 1.0)
    return np.asarray(np.sqrt(squares / count))


def contradicts_signs(
    found: Posterior, parameters: ParameterSet, observations: Observations
) -> bool:
    """Return whether the efforts contradict armature and friction that are all positive.

    ``found`` is the posterior of the candidate terms, from these observations.
    """
    relaxed = replace(parameters, signed_drives=True)
    tested = parameters.nonnegative & ~relaxed.nonnegative
    if not tested.any():
        return False

    def best(parameters: ParameterSet) -> ConsistentSolution:
        return consistent_minimum(
            found.factor,
            found.factor @ found.mean,
            found.prior.std,
            len(parameters.links),
            drive_bounds(parameters, observations),
        )

    signed = best(relaxed)
    if not np.any(tested & _is_felt(np.minimum(signed.value, 0.0), parameters, observations)):
        return False
    loss = best(parameters).moved ** 2 - signed.moved**2
    return bool(loss > chdtri(np.count_nonzero(tested), CHANCE))


def _is_felt(value: FloatArray, parameters: ParameterSet, observations: Observations) -> BoolArray:
    """Return which joint terms (p,) with these values contribute to the efforts of their joints.

    Joints without rows of their own feel every term.
    """
    felt = np.zeros(len(parameters), bool)
    efforts = observations.rows.target_squares / np.maximum(observations.counts.diagonal(), 1.0)
    rms = np.sqrt(efforts[6 * parameters.model.floating + parameters.joints])
    least = LEAST_SHARE * np.maximum(rms, LEAST_EFFORT * np.sqrt(efforts.max()))
    for columns in parameters.term_columns.values():
        size = np.abs(value[columns])
        moved = size * _column_rms(columns, parameters, observations)
        felt[columns] = (size > 0) & ((rms == 0) | (moved > least))
    return felt
