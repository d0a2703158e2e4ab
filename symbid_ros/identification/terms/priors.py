"""Prior deviations of candidate joint terms, which suit the efforts of the log."""

from dataclasses import replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.parameters import ParameterSet

# Deviation of a fixed term, as a share of its prior deviation: far below what any data resolve.
FIXED = 1e-7
# Smallest prior deviation of an armature, as a share of that by which it explains all effort. The
# geared rotor of a light link may explain half of it: with a share of 0.02 the prior outweighed the
# data of such a finger in five of six logs, with 0.05 in two, and with 0.1 in none.
LEAST_SHARE = 0.1
# Root mean square, in SI units, below which a column is zero but for rounding, as that of
# presliding friction is for a joint that does not reverse.
ROUNDING = 1e-9
POSTURES = 20
RATES = "velocity", "acceleration", "base_angular_velocity", "base_angular_acceleration"


def fixed_prior(prior: Prior, free: BoolArray) -> Prior:
    """Return the prior with the parameters that are not free fixed at their means."""
    scale = np.ones(len(prior.mean))
    scale[: len(free)][~free] = FIXED
    if prior.factor is None:
        return prior.widened(scale)
    factor = prior.factor * scale[:, None]
    alone = None if prior.alone is None else prior.alone * scale
    return replace(prior, std=np.linalg.norm(factor, axis=1), factor=factor, alone=alone)


def released_prior(prior: Prior, columns: IntArray) -> Prior:
    """Return a prior by :func:`fixed_prior` with some parameters as they were before."""
    scale = np.ones(len(prior.mean))
    scale[columns] = 1 / FIXED
    factor = prior.covariance_factor() * scale[:, None]
    return replace(prior, std=np.linalg.norm(factor, axis=1), factor=factor, alone=None)


def candidate_prior(
    prior: Prior,
    parameters: ParameterSet,
    observations: Observations,
    factors: FloatArray | None = None,
) -> Prior:
    """Return the prior in which each term's deviation suits the efforts that the joint needs.

    With that deviation alone a term may explain the whole root mean square effort of its rows. An
    armature is rather of the size of the inertia that the joint moves. These replace default
    deviations, which do not know the robot's size; those of the user remain. A value of the model
    file is the mean, and may be wrong by itself. ``factors`` (J,) convert efforts of unknown units.
    """
    model, has_contacts = parameters.model, parameters.model.contacts is not None
    free = replace(parameters, model=replace(model, contacts=None)) if has_contacts else parameters
    inertia = _joint_inertia(free, prior.mean)
    std, rows, assumed = prior.std.copy(), observations.rows, set(prior.assumed)
    first = 6 * model.floating
    least = ROUNDING**2 * observations.counts.diagonal()
    efforts = rows.target_squares.copy()
    if factors is not None:
        efforts[first:] *= factors**2
    joints = parameters.joints.tolist()
    for term, columns in parameters.term_columns.items():
        for joint, column in zip(joints, range(columns.start, columns.stop), strict=True):
            if parameters.names[column] not in assumed:
                continue
            affected = [first + joint]
            if has_contacts:  # rows combine the efforts of several joints
                affected = np.flatnonzero(rows.layout.structure[:, column]).tolist()
            square = sum(rows.column_squares(one, column) for one in affected)
            effort = float(efforts[affected].sum())
            if square > least[affected].sum() and effort > 0:
                std[column] = np.sqrt(effort / square)
                if term == "armature":
                    std[column] = max(inertia[joint], LEAST_SHARE * std[column])
            std[column] = max(std[column], abs(prior.mean[column]))
    if has_contacts:
        return prior.widened(std / prior.std)
    further = [
        (coupling.joints, coupled.values())
        for coupling, coupled in parameters.coupling_columns.items()
    ] + [
        ((one.joint,), range(columns.start, columns.stop))
        for one, columns in parameters.further_columns.items()
    ]
    for owners, own in further:
        coordinates = [first + joint for joint in owners]
        for column in own:
            squares = np.array([rows.column_squares(one, column) for one in coordinates])
            is_moved = np.all(squares > least[coordinates])
            if parameters.names[column] in assumed and is_moved:
                std[column] = np.sqrt(np.max(efforts[coordinates] / squares))
    return prior.widened(std / prior.std)


def named_term_prior(
    prior: Prior,
    parameters: ParameterSet,
    observations: Observations,
    factors: FloatArray | None = None,
) -> Prior:
    """Return the prior in which named terms are at least as uncertain as candidates.

    Default deviations suit a leg. A harmonic drive that rubs a hundred times as much would keep
    none of its friction.
    """
    sized = candidate_prior(prior, parameters, observations, factors)
    return prior.widened(np.maximum(sized.std / prior.std, 1.0))


def _joint_inertia(parameters: ParameterSet, phi: FloatArray) -> FloatArray:
    """Return the inertia (J,) that each joint moves with the others at rest, over its postures."""
    model = parameters.model
    count, first = POSTURES, 6 * model.floating
    still = random_motions(model, count)
    still = replace(
        still, **{name: 0.0 * getattr(still, name) for name in RATES}, effort=still.effort
    )
    inertia = np.empty(len(model.joints))
    links = np.append(phi[: parameters.inertial], np.zeros(len(parameters) - parameters.inertial))
    at_rest = equation_of_motion(parameters, still).K @ links
    for joint in range(len(model.joints)):
        acceleration = np.zeros_like(still.acceleration)
        acceleration[:, joint] = 1.0
        force = equation_of_motion(parameters, replace(still, acceleration=acceleration)).K @ links
        inertia[joint] = np.mean(np.abs(force - at_rest)[:, first + joint])
    return inertia
