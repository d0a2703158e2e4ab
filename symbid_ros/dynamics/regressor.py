"""Regressors: forces, momentum and centre of mass as linear functions of the parameters.

The equation of motion is K φ = y (Eq. 6, 10–14, 2.46–2.49).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import Term
from symbid_ros.dynamics.friction import (
    coulomb_column,
    creep_column,
    lead_column,
    load_column,
    presliding_column,
    sliding_column,
    stribeck_column,
)
from symbid_ros.dynamics.inertial_rows import (
    PackedLayout,
    averaged_rows,
    body_integrals,
    dense_rows,
)
from symbid_ros.dynamics.kinematics import (
    JointTable,
    LinkPoses,
    Posture,
    cache_blocks,
    component_first,
    cross,
    link_velocity,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import all_without_contacts, without_contacts
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet


@dataclass(frozen=True)
class Rows:
    """N samples of the equation of motion.

    Attributes
    ----------
    K : (N, n, p) float64
        Regressor. The base's rows come first: moment, then force, in base axes about the base's
        origin. One row per joint follows.
    y : (N, n) float64
        Generalised force of motors and environment minus known joint terms, Nm and N.
    """

    K: FloatArray
    y: FloatArray

    def masked(self, valid: BoolArray) -> "Rows":
        """Return the rows with zeros where ``valid`` (N, n) is false."""
        if valid.all():
            return self
        return Rows(self.K * valid[:, :, None], self.y * valid)


def equation_of_motion(parameters: ParameterSet, samples: Samples) -> Rows:
    """Return the rows of K φ = y for a block of samples.

    Known joint terms (:attr:`ParameterSet.known_terms`) and payloads are subtracted from y.
    Unmeasured contact wrenches (:attr:`RobotModel.contacts`) are eliminated.
    """
    model = parameters.model
    first_joint = 6 * model.floating
    K, y = dense_rows(parameters, samples)
    if len(parameters) > parameters.inertial:
        for coordinates, places, factor in _term_entries(parameters, samples):
            K[:, coordinates, places] = factor
    model.fold_followers(K)
    for payload in parameters.payloads:
        column = 10 * int(np.searchsorted(parameters.links, payload.link))
        carried = payload.is_carried(samples.stamp)
        y -= carried[:, None] * (K[:, :, column : column + 10] @ payload.phi)
    if "load" in parameters.terms and model.contacts is None:  # else the load is unknown
        columns = parameters.term_columns["load"]
        needed = K[:, :, : parameters.inertial] @ parameters.load_reference
        factor = load_column(parameters, samples, needed, y)[:, parameters.joints]
        K[:, first_joint + parameters.joints, range(columns.start, columns.stop)] = factor
    if parameters.known_terms:
        y -= known_force(parameters, samples)
    if model.contacts is not None:
        K, forces = all_without_contacts(model, samples, K, y[..., None])
        y = forces[..., 0]
    return Rows(K, y)


def has_linear_rows(parameters: ParameterSet) -> bool:
    """Return whether the rows are linear in K and y with constant factors.

    Rows without unmeasured contacts are not: their combinations vary with the posture.
    """
    return parameters.model.contacts is None


def averaged_equation_of_motion(
    parameters: ParameterSet, samples: Samples, weights: csr_array
) -> tuple[FloatArray, FloatArray]:
    """Return weighted sums of the regressor over windows, without storing that of each sample.

    Parameters
    ----------
    parameters : ParameterSet
        With :func:`has_linear_rows`.
    samples : Samples
        N samples.
    weights : (W, N) csr_array
        Weights of the samples in each window; a window's samples are consecutive.

    Returns
    -------
    K : (W, n, p) float64
        Sums of K.
    y : (N, n) float64
        Generalised force y of each sample.
    """
    model = parameters.model
    layout = PackedLayout.of(parameters)
    wanted = [parameters.load_reference]
    wanted += [_of_link(parameters, payload.link, payload.phi) for payload in parameters.payloads]
    phi = np.array(wanted)
    if "load" not in parameters.terms and not parameters.payloads:
        phi = phi[:0]
    K = np.zeros((weights.shape[0], model.dof, len(parameters)))
    packed, y, forces = averaged_rows(parameters, samples, weights, phi)
    K[:, layout.row, layout.column] = packed
    for coordinates, places, factor in _term_entries(parameters, samples):
        K[:, coordinates, places] = weights @ factor
    for force in (K, *forces):
        model.fold_followers(force)
    for payload, force in zip(parameters.payloads, forces[1:], strict=True):
        y -= payload.is_carried(samples.stamp)[:, None] * force
    if "load" in parameters.terms:
        columns = parameters.term_columns["load"]
        factor = load_column(parameters, samples, forces[0], y)[:, parameters.joints]
        coordinates = 6 * model.floating + parameters.joints
        K[:, coordinates, range(columns.start, columns.stop)] = weights @ factor
    if parameters.known_terms:
        y -= known_force(parameters, samples)
    return K, y


def equation_residual(parameters: ParameterSet, samples: Samples, phi: FloatArray) -> FloatArray:
    """Return y - K φ (N, n) of a block of samples for φ (p,), without storing K if possible.

    The rows are those of :func:`equation_of_motion`.
    """
    model = parameters.model
    if model.contacts is not None:
        every = replace(parameters, model=replace(model, contacts=None))
        if "load" in parameters.terms:  # which is unknown then
            phi = phi.copy()
            phi[parameters.term_columns["load"]] = 0.0
        residual = equation_residual(every, samples, phi)
        return without_contacts(model, samples, residual[..., None])[..., 0]
    wanted = [phi[: parameters.inertial], parameters.load_reference]
    wanted += [_of_link(parameters, payload.link, payload.phi) for payload in parameters.payloads]
    none = csr_array((0, len(samples)))
    _, y, forces = averaged_rows(parameters, samples, none, np.array(wanted))
    own = np.zeros_like(y)
    for coordinates, places, factor in _term_entries(parameters, samples):
        if len(np.unique(coordinates)) == len(coordinates):
            own[:, coordinates] += factor * phi[places]
        else:  # of one joint's ripple or warming
            own[:, coordinates[0]] += factor @ phi[places]
    for force in (*forces, own):
        model.fold_followers(force)
    for payload, force in zip(parameters.payloads, forces[2:], strict=True):
        y -= payload.is_carried(samples.stamp)[:, None] * force
    if "load" in parameters.terms:
        columns = parameters.term_columns["load"]
        factor = load_column(parameters, samples, forces[1], y)[:, parameters.joints]
        own[:, 6 * model.floating + parameters.joints] += factor * phi[columns]
    if parameters.known_terms:
        y -= known_force(parameters, samples)
    return np.asarray(y - forces[0] - own)


def _of_link(parameters: ParameterSet, link: int, phi: FloatArray) -> FloatArray:
    """Return inertial parameters that are zero but for those of one link, φ (10,)."""
    all_links = np.zeros((parameters.inertial // 10, 10))
    all_links[np.searchsorted(parameters.links, link)] = phi
    return all_links.reshape(-1)


def known_force(parameters: ParameterSet, samples: Samples) -> FloatArray:
    """Return the generalised force (N, n) of known friction and armature, zero at the base."""
    content = _joint_terms(parameters, samples)
    force = np.zeros((len(samples), parameters.model.dof))
    joints = force[:, 6 * parameters.model.floating :]
    for term, values in parameters.known_terms.items():
        joints += values * content[term]
    parameters.model.fold_followers(force)
    return force


def _term_entries(
    parameters: ParameterSet, samples: Samples
) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Yield coordinates (k,), parameters (k,) and factors (N, k) of joint terms and offsets.

    Each joint's term enters its own row.
    """
    content = _joint_terms(parameters, samples)
    joints, first = parameters.joints, 6 * parameters.model.floating
    for term, columns in parameters.term_columns.items():
        if term in content:
            factor = np.broadcast_to(content[term], samples.velocity.shape)
            yield first + joints, np.arange(columns.start, columns.stop), factor[:, joints]
    for coupling, coupled in parameters.coupling_columns.items():
        of_drive = _coupled_terms(parameters, coupling, samples)
        for joint, ratio in zip(coupling.joints, coupling.ratios, strict=True):
            if joint in parameters.link_side:
                continue
            for term, column in coupled.items():
                factor = ratio * of_drive[term]
                yield np.array([first + joint]), np.array([column]), factor[:, None]
    for ripple, own in parameters.ripple_columns.items():
        places = np.arange(len(parameters))[own]
        coordinates = np.full(len(places), first + ripple.joint)
        yield coordinates, places, ripple.columns(samples.position)
    shares = [one.columns(samples.stamp) for one in parameters.warming[:1]]  # alike for all
    for warming, own in parameters.warming_columns.items():
        places = np.arange(len(parameters))[own]
        coordinates = np.full(len(places), first + warming.joint)
        yield coordinates, places, content[warming.term][:, warming.joint, None] * shares[0]
    offset = parameters.sensor_offsets.start
    for place in parameters.model.wrist_sensors.values():
        # The effort of these joints is minus the reading, which contains the offset.
        factor = np.full((len(samples), 6), -1.0)
        yield first + np.arange(place.start, place.stop), np.arange(offset, offset + 6), factor
        offset += 6


def _joint_terms(parameters: ParameterSet, samples: Samples) -> dict[Term, FloatArray]:
    """Return the factor (N, J) of each joint term that needs no force, extending Eq. 2.49.

    The armature is the inertia of rotor and gear reflected to the joint, and moves with q̇_j
    alone. As in MuJoCo, the rotor's motion with its link is neglected, because it is small
    compared to the geared motion (Featherstone 2008, sec. 9.6).
    """
    joints, velocity = parameters.model.joints, samples.velocity
    armature = samples.acceleration
    if parameters.link_side:
        armature = armature.copy()
        armature[:, parameters.link_side] = 0.0
    sliding = sliding_column(samples, joints)
    factors: dict[Term, FloatArray] = {
        "viscous": velocity,
        "coulomb": sliding,
        "armature": armature,
        "offset": np.ones(1),
        "stribeck": stribeck_column(velocity, joints, sliding),
        "stiffness": samples.position - np.array([joint.spring_reference for joint in joints]),
    }
    if "presliding" in parameters.terms:
        factors["presliding"] = presliding_column(samples, joints)
    if "lead" in parameters.terms:
        factors["lead"] = lead_column(samples, joints)
    if "creep" in parameters.terms:
        factors["creep"] = creep_column(samples, joints)
    return factors


def _coupled_terms(
    parameters: ParameterSet, coupling: Coupling, samples: Samples
) -> dict[Term, FloatArray]:
    """Return the factor (N,) of each term of a coupled drive, a function of the drive's speed."""
    speed = coupling.speed(samples.velocity)
    joint = parameters.model.joints[coupling.joints[0]]
    return {
        "viscous": speed,
        "coulomb": coulomb_column(speed[:, None], [joint])[:, 0],
        "armature": coupling.speed(samples.acceleration),
        "stribeck": stribeck_column(speed[:, None], [joint])[:, 0],
    }


def com_position(parameters: ParameterSet, values: FloatArray, poses: LinkPoses) -> FloatArray:
    """Return the centre of mass (N, 3) in the base frame, m, for parameters (p,)."""
    com: FloatArray = first_moment_regressor(parameters, poses) @ values
    com /= parameters.link_phi(values)[:, 0].sum()
    return com


def first_moment_regressor(parameters: ParameterSet, poses: LinkPoses) -> FloatArray:
    """Return C (N, 3, p), where C φ is the robot's first moment in the base frame, kg m."""
    links, count = parameters.links, parameters.inertial
    C = np.zeros((len(poses.position), 3, len(parameters)))
    by_link = C[:, :, :count].reshape(len(C), 3, len(links), 10)
    by_link[..., 0] = poses.position[:, links].transpose(0, 2, 1)
    by_link[..., 1:4] = poses.rotation[:, links].transpose(0, 2, 1, 3)
    C[:, :, :count] = by_link.reshape(len(C), 3, count)
    return C


def momentum_regressor(
    parameters: ParameterSet, samples: Samples, base_velocity: FloatArray, poses: LinkPoses
) -> FloatArray:
    """Return M (N, 6, p), where M φ is the momentum (angular; linear) about the base's origin.

    Parameters
    ----------
    parameters : ParameterSet
        The robot and its columns. The columns of joint terms are zero.
    samples : Samples
        Joint positions and velocities, and the base's angular velocity.
    base_velocity : (N, 3) float64
        Linear velocity of the base's origin, in base axes, m/s.
    poses : LinkPoses
        Link poses of the samples.
    """
    joints = JointTable.of(parameters.model.joints)
    M = np.zeros((len(samples), 6, len(parameters)))
    for part in cache_blocks(len(samples), len(parameters.model.links)):
        posture = Posture.of(joints, LinkPoses(poses.rotation[part], poses.position[part]))
        omega, velocity = link_velocity(
            posture,
            component_first(samples.velocity[part]),
            component_first(samples.base_angular_velocity[part]),
            component_first(base_velocity[part]),
        )
        pose_rate = np.empty_like(posture.pose)
        pose_rate[:, :3] = cross(omega[:, None], posture.rotation)
        pose_rate[:, 3] = velocity
        M[part, :, : parameters.inertial] = body_integrals(parameters, posture.pose, pose_rate)
    return M


def centroidal(momentum: FloatArray, com: FloatArray) -> FloatArray:
    """Return momentum (N, 6) about the centre of mass (N, 3) instead of the base's origin."""
    moved = momentum.copy()
    moved[:, :3] -= cross(com.T, momentum[:, 3:].T).T
    return moved
