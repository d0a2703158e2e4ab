"""Standard deviations of priors, from the scales of links and joints and from half-widths."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import JOINT_TERMS, JointTerm
from symbid_ros.model.inertia import (
    com_from_phi,
    phi_from_com,
    phi_from_pseudo_inertia,
    pseudo_inertia,
    second_moments,
)
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint

# A slide gets the terms of a revolute drive with this lever, m.
_SLIDE_LEVER = 0.1
# Smallest deviation, as a share of the deviation at the parameter's own scale.
_FLOOR = 0.01
# Deviation of a payload's mass, as a share of the robot's mass: what people and robots pick up.
PAYLOAD = 0.1
# Smallest extent of a loaded link, m, because the payload may stick out.
_LEAST_EXTENT = 0.05
# The same for what lies beyond a wrist sensor, which is measured and need not be guessed.
SENSED_MASS, SENSED_EXTENT = 0.2, 0.2
# Deviations of a wrist sensor's offset, Nm and N: few sensors read more when unloaded.
OFFSET_STD = (10.0,) * 3 + (100.0,) * 3
# Deviation of the amplitude of a ripple, Nm; data replace it.
RIPPLE_STD = 1.0
# Scale of a link without mass or extent in the file.
_BARE_MASS, _BARE_EXTENT = 1.0, 0.1


def percent_std(parameters: ParameterSet, mean: FloatArray, percent: float) -> FloatArray:
    """Return the deviation of a uniform ± percent, with a positive floor for zero values."""
    uniform = percent / 100 * np.abs(mean) / np.sqrt(3)
    return _with_defaults(np.maximum(uniform, percent_floor(parameters, percent)), parameters)


def absolute_std(parameters: ParameterSet, amount: float) -> FloatArray:
    """Return the deviation of a uniform ± amount for the values that the file gives."""
    return _with_defaults(np.full(len(parameters), amount / np.sqrt(3)), parameters)


def _with_defaults(std: FloatArray, parameters: ParameterSet) -> FloatArray:
    """Return deviations (p,) with the defaults of joint terms that the file does not give.

    Those of links beyond wrist sensors allow for any payload.
    """
    joints = slice(parameters.inertial, None)
    std[joints] = np.where(is_stated(parameters)[joints], std[joints], term_scale(parameters))
    _widen_beyond_sensors(std, parameters)
    return std


def _widen_beyond_sensors(std: FloatArray, parameters: ParameterSet) -> None:
    """Allow for any payload in the deviations (p,) of the links beyond wrist sensors, in place."""
    mass = SENSED_MASS * abs(parameters.values[: parameters.inertial : 10].sum())
    scale = (mass or _BARE_MASS) * SENSED_EXTENT ** np.repeat([0, 1, 2], [1, 3, 6])
    for own in beyond_sensors(parameters):
        std[own] = np.maximum(std[own], scale)


def beyond_sensors(parameters: ParameterSet) -> tuple[slice, ...]:
    """Return the parameters of the first link beyond each wrist sensor."""
    links = parameters.links.tolist()
    firsts = [10 * links.index(place.stop) for place in parameters.model.wrist_sensors.values()]
    return tuple(slice(first, first + 10) for first in firsts)


def consistent_covariance(root: FloatArray, half_width: float) -> FloatArray:
    """Return the covariance (10, 10) of φ under J → L S Lᵀ, where ``root`` is L (4, 4).

    With iid eigenvalues of variance σ² and axes uniform over O(4), S has
    E[S_ij S_kl] - E[S_ij] E[S_kl] = σ²/6 (δ_ij δ_kl + δ_ik δ_jl + δ_il δ_jk).
    """
    variance = half_width**2 / 3 / 6
    # φ of L S Lᵀ per unit of S's entry (i, j).
    moved = np.einsum("ai,bj->ijab", root, root)
    spread = phi_from_pseudo_inertia((moved + moved.swapaxes(2, 3)) / 2)
    trace = np.einsum("iik->k", spread)
    covariance: FloatArray = variance * (
        np.outer(trace, trace) + 2 * np.einsum("ijk,ijl->kl", spread, spread)
    )
    return covariance


def link_floor(parameters: ParameterSet, percent: float) -> FloatArray:
    """Return :func:`percent_floor`, and what any payload allows beyond wrist sensors."""
    floor = percent_floor(parameters, percent)
    _widen_beyond_sensors(floor, parameters)
    return floor


def body_std(phi: FloatArray, percent: float) -> FloatArray:
    """Return the deviations (10,) that :func:`body_covariance` gives."""
    std: FloatArray = np.sqrt(np.diag(body_covariance(phi, percent)))
    return std


def body_covariance(phi: FloatArray, percent: float) -> FloatArray:
    """Return the covariance (10, 10) of a link φ of which every moment is uniform ± percent.

    That of :func:`consistent_covariance`; a link that no body has is projected onto one.
    """
    values, axes = np.linalg.eigh(pseudo_inertia(phi))
    return consistent_covariance(axes * np.sqrt(np.maximum(values, 0.0)), percent / 100)


def stated_covariance(phi: FloatArray, half_width: float) -> FloatArray:
    """Return the covariance (10, 10) of φ if each number of a model file is wrong by itself.

    These are the mass, the coordinates of the centre of mass, and the central inertia, each uniform
    within ± ``half_width`` of its value; to first order. That of a link without mass is zero.
    """
    mass, com, central = com_from_phi(phi)
    share, nothing = half_width / np.sqrt(3), np.zeros((3, 3))
    if mass <= 0:
        return np.zeros((10, 10))
    effects = [phi_from_com(share * mass, com, nothing)]
    for offset in share * np.diag(com):
        ends = (phi_from_com(mass, com + sign * offset, nothing) for sign in (1, -1))
        effects.append(np.subtract(*ends) / 2)
    effects += list(np.diag(share * phi_from_com(0.0, com, central))[4:])
    columns = np.transpose(effects)
    covariance: FloatArray = columns @ columns.T
    return covariance


def percent_floor(parameters: ParameterSet, percent: float) -> FloatArray:
    """Return 1 % of :func:`sized_std`.

    The floor makes zeros in the file uncertain. It is small, so that small true values keep their
    own scale.
    """
    return _FLOOR * sized_std(parameters, percent)


def sized_std(parameters: ParameterSet, percent: float) -> FloatArray:
    """Return the deviations (p,) of a uniform ± percent of each link's scale {m, mℓ, mℓ²}.

    ℓ is the link's root-mean-square extent about its origin. The scale of a joint term is
    ``JOINT_TERMS[...].std``.
    """
    unit = percent / 100 / np.sqrt(3)
    std = np.empty(len(parameters))
    std[parameters.inertial :] = unit * term_scale(parameters)
    for index, phi in enumerate(parameters.link_phi(parameters.values)):
        mass, extent = abs(phi[0]) or _BARE_MASS, link_extent(phi) or _BARE_EXTENT
        scale = np.repeat([mass, mass * extent, mass * extent**2], [1, 3, 6])
        std[10 * index : 10 * index + 10] = unit * scale
    return std


def link_extent(phi: FloatArray) -> float:
    """Return a link's root-mean-square extent about its origin, m; 0 for a link without mass."""
    mass = abs(phi[0])
    return float(np.sqrt(max(np.trace(second_moments(phi)), 0.0) / mass)) if mass > 0 else 0.0


def payload_std(parameters: ParameterSet, mean: FloatArray) -> FloatArray:
    """Return the deviations (links, 10) that a payload adds to each link of the robot ``mean``."""
    means = parameters.link_phi(mean[: len(parameters)])
    mass = PAYLOAD * means[:, 0].sum()
    extents = np.maximum([link_extent(phi) for phi in means], _LEAST_EXTENT)
    powers = np.repeat([0, 1, 2], [1, 3, 6])
    std: FloatArray = mass * extents[:, None] ** powers
    return std


def is_stated(parameters: ParameterSet) -> BoolArray:
    """Return (p,) whether the model file gives the parameter: all of links, non-zero of joints."""
    stated: BoolArray = parameters.values != 0.0
    stated[: parameters.inertial] = True
    return stated


def term_scale(parameters: ParameterSet) -> FloatArray:
    """Return the deviations of joint terms about which nothing is known, and of offsets."""
    joints = parameters.model.joints
    pairs = [(term, joints[place]) for term in parameters.terms for place in parameters.joints]
    for coupling, terms in parameters.coupling_columns.items():
        pairs += [(term, joints[coupling.joints[0]]) for term in terms]
    ripples = [RIPPLE_STD] * (2 * len(parameters.ripples))
    changes = [
        _std_of(JOINT_TERMS[one.term], joints[one.joint])
        for one in parameters.warming
        for _ in one.terms
    ]
    offsets = OFFSET_STD * len(parameters.model.wrist_sensors)
    scales = [_std_of(JOINT_TERMS[term], joint) for term, joint in pairs]
    return np.array([*scales, *ripples, *changes, *offsets])


def _std_of(term: JointTerm, joint: Joint) -> float:
    is_slide = joint.kind == "prismatic"
    return term.std / (_SLIDE_LEVER**term.lever_power if is_slide else 1.0)
