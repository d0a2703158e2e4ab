"""Regressors: forces, momentum and centre of mass as linear functions of the parameters.

The equation of motion is K φ = y (Eq. 6, 10–14, 2.46–2.49).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays
from symbid_ros.choices import Term
from symbid_ros.dynamics.kinematics import (
    JointTable,
    LinkPoses,
    Posture,
    cache_blocks,
    component_first,
    cross,
    link_motion,
    link_velocity,
    sample_first,
)
from symbid_ros.dynamics.unmeasured_contacts import without_contacts
from symbid_ros.dynamics.wrenches import wrenches_at_base
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.inertia import pseudo_inertia
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint, RobotModel

# Pseudo-inertia J of one unit of each parameter, (10, 16).
UNIT_PSEUDO_INERTIA = pseudo_inertia(np.eye(10)).reshape(10, 16)

# Below this speed, rad/s or m/s, a joint may stick, and static friction balances the other forces.
COULOMB_SPEED = 0.02
# Speed below which the column of Coulomb friction is a ramp.
COULOMB_RAMP = 0.004
# Speed at which Stribeck friction has fallen to 1/e: revolute joints rad/s, prismatic joints m/s.
STRIBECK_SPEED = 0.2, 0.02
# Travel after a reversal within which friction builds up to 63 %, in presliding: revolute joints
# rad, prismatic joints m. It is about the hysteresis of a strain wave gear.
PRESLIDING_TRAVEL = 2e-3, 2e-4


@dataclass(frozen=True)
class Samples:
    """Motion of a robot and forces on it at N instants.

    Joint columns are in model order. Base quantities are in base axes at the base's origin. A
    fixed base has zero rates, and its specific force is minus gravity.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    position, velocity, acceleration : (N, J) float64
        Joint motion, rad or m.
    effort : (N, J) float64
        Joint torques or forces applied by the motors, Nm or N.
    base_angular_velocity, base_angular_acceleration : (N, 3) float64
        rad/s and rad/s².
    base_specific_force : (N, 3) float64
        Acceleration of the base's origin minus gravity, m/s².
    wrenches : (N, F, 6) float64
        Per sensor the (moment; force) of the environment on the robot, in the sensor frame's
        axes about its origin.
    wrench_frames : tuple of str
        Names of the F sensor frames.
    touching : (N, C) bool or None
        Which contacts without a sensor touch something; None if all may.
    sliding, friction_state : (N, J) float64 or None
        Of :func:`coulomb_column` and :func:`friction_state`, filtered like the efforts; None for
        single instants.
    """

    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    base_angular_velocity: FloatArray
    base_angular_acceleration: FloatArray
    base_specific_force: FloatArray
    wrenches: FloatArray
    wrench_frames: tuple[str, ...]
    touching: BoolArray | None = None
    sliding: FloatArray | None = None
    friction_state: FloatArray | None = None

    @classmethod
    def none(cls, joint_names: tuple[str, ...]) -> "Samples":
        """Return no instants of a robot without wrench sensors."""
        joints, base = np.zeros((0, len(joint_names))), np.zeros((0, 3))
        stamp = np.zeros(0, dtype=np.int64)
        return cls(stamp, joints, joints, joints, joints, base, base, base, np.zeros((0, 0, 6)), ())

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, index: slice | IntArray) -> "Samples":
        """Return the samples at a slice or at indices."""
        return map_arrays(self, lambda values: values[index])

    def blocks(self, size: int) -> Iterator["Samples"]:
        """Yield consecutive blocks of at most ``size`` samples."""
        for start in range(0, len(self), size):
            yield self[start : start + size]


def body_integrals(parameters: ParameterSet, pose: FloatArray, pose_rate: FloatArray) -> FloatArray:
    """Return ∫ (x × u; u) dm about the base's origin per unit parameter, (N, 6, inertial).

    A body's points x = X ξ, ξ homogeneous in link axes, have rates u = U ξ, so that
    ∫ x uᵀ dm = X J Uᵀ with the pseudo-inertia J = ∫ ξξᵀ dm, linear in the parameters
    (Wensing, Kim and Slotine 2018). With u = ẋ the integral is the body's momentum. With
    u = ẍ - g it is the wrench on the body, bX_l^F A_l of Eq. 11 and 14. This corrects -S(ṗ) of
    the thesis's Eq. 2.38 to -S(p̈).

    Parameters
    ----------
    parameters : ParameterSet
        The links with parameters.
    pose, pose_rate : (3, 4, L, N) float64
        X and U of all links, in base axes: rotation (or its rate), then origin (or its rate).
    """
    if len(parameters.links) < pose.shape[2]:
        pose, pose_rate = pose[:, :, parameters.links], pose_rate[:, :, parameters.links]
    links, count = pose.shape[2:]
    integrals = np.empty((6, links, 10, count))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        # One axis at a time, because the products of all three do not fit the cache.
        products = pose[i, :, None] * pose_rate[j]
        products -= pose[j, :, None] * pose_rate[i]
        moment = UNIT_PSEUDO_INERTIA @ products.reshape(16, links * count)
        integrals[axis] = moment.reshape(10, links, count).swapaxes(0, 1)
    integrals[3:, :, 0] = pose_rate[:, 3]
    integrals[3:, :, 1:4] = pose_rate[:, :3].swapaxes(1, 2)
    integrals[3:, :, 4:] = 0.0
    return integrals.reshape(6, parameters.inertial, count).transpose(2, 0, 1)


def is_slipping(velocity: FloatArray) -> BoolArray:
    """Return whether joints (N, J) move at ``COULOMB_SPEED`` or faster.

    Friction in a sticking joint takes any value up to ± its Coulomb friction, so the joint's row
    of the equation of motion is valid only while the joint slips.
    """
    moves: BoolArray = np.abs(velocity) >= COULOMB_SPEED
    return moves


def coulomb_column(velocity: FloatArray) -> FloatArray:
    """Return sign(q̇) (N, J) of Eq. 2.49, with a linear ramp below ``COULOMB_RAMP``.

    Without the ramp, noise about zero speed would switch the friction's sign. The ramp does not
    model stiction. It ends far below ``COULOMB_SPEED``: a window of a slipping joint may contain a
    few slower samples, and a column of less than one there would bias the friction.
    """
    column: FloatArray = np.clip(velocity / COULOMB_RAMP, -1.0, 1.0)
    return column


def sliding_column(samples: Samples) -> FloatArray:
    """Return :func:`coulomb_column` (N, J) of samples, filtered if they are."""
    return coulomb_column(samples.velocity) if samples.sliding is None else samples.sliding


def stribeck_column(
    velocity: FloatArray, joints: Sequence[Joint], sliding: FloatArray | None = None
) -> FloatArray:
    """Return sign(q̇) exp(-|q̇|/v) (N, J), how friction falls with speed after a joint breaks away.

    With a fixed speed v the column is linear in its parameter (Bona and Indri 2005, Proc. 44th
    IEEE CDC). Together with Coulomb and viscous friction it also represents viscous friction that
    saturates with speed, as that of harmonic drives.
    """
    speed = _by_kind(STRIBECK_SPEED, joints)
    if sliding is None:
        sliding = coulomb_column(velocity)
    column: FloatArray = sliding * np.exp(-np.abs(velocity) / speed)
    return column


def friction_state(position: FloatArray, joints: Sequence[Joint]) -> FloatArray:
    """Return the state z (N, J) of Dahl's friction, from -1 to 1, along joint positions (N, J).

    When a joint reverses, the asperities of bearings and gears bend first, and friction changes
    its sign within a travel x: dz/dq = (sign(q̇) - z)/x (Dahl 1968, A solid friction model,
    Aerospace Corp. TOR-0158). The first motion is assumed to have lasted longer than x.
    """
    count = len(position)
    step = np.diff(position, axis=0)
    # From one sample to the next z becomes gain z + shift. Composing such maps in pairs, fours,
    # eights and so on gives all samples without a loop over them.
    gain = np.ones((count, len(joints)))
    shift = np.zeros_like(gain)
    gain[1:] = np.exp(-np.abs(step) / _by_kind(PRESLIDING_TRAVEL, joints))
    shift[1:] = np.sign(step) * (1 - gain[1:])
    if count > 1:
        moves = step != 0
        first = np.take_along_axis(step, np.argmax(moves, axis=0)[None], axis=0)[0]
        shift[0], gain[0] = np.sign(first), 0.0
    reach = 1
    while reach < count:
        shift[reach:] += gain[reach:] * shift[:-reach]
        gain[reach:] *= gain[:-reach]
        reach *= 2
    return shift


def presliding_column(samples: Samples, joints: Sequence[Joint]) -> FloatArray:
    """Return z - sign(q̇) (N, J), by which friction lags behind Coulomb friction after a reversal.

    Together with as much Coulomb friction this is Dahl's friction; with less, a part of the
    friction reverses at once. Samples without the state z are taken to accelerate constantly since
    they reversed, s = q̇²/(2 |q̈|) ago, hence z = sign(q̇) (1 - 2 exp(-s/x)).
    """
    state = samples.friction_state
    if state is None:
        velocity, acceleration = samples.velocity, samples.acceleration
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = velocity**2 / (2 * np.abs(acceleration))
        distance[velocity * acceleration <= 0] = np.inf  # it will reverse, if at all
        share = 1 - 2 * np.exp(-distance / _by_kind(PRESLIDING_TRAVEL, joints))
        state = np.sign(velocity) * share
    column: FloatArray = state - sliding_column(samples)
    return column


def _by_kind(values: tuple[float, float], joints: Sequence[Joint]) -> FloatArray:
    """Return a value (J,) for each joint, of those for revolute and prismatic ones."""
    return np.array([values[joint.kind == "prismatic"] for joint in joints])


def load_column(
    parameters: ParameterSet, samples: Samples, K: FloatArray, y: FloatArray
) -> FloatArray:
    """Return sign(q̇) |τ| (N, J), Coulomb friction in proportion to the load of the gear.

    The load τ is the effort that the reference inertias need, so that the column depends on the
    motion and the contacts alone and predictions need no efforts (Hamon, Gautier and Garrec 2010,
    Dynamic identification of robots with a dry friction model depending on load and velocity,
    IROS). A wrong size of the reference enters the parameter.

    Parameters
    ----------
    parameters : ParameterSet
    samples : Samples
    K : (N, n, p) float64
        Regressor; the columns of links are used.
    y : (N, n) float64
        Generalised force, from which that of the efforts is subtracted.
    """
    first = 6 * parameters.model.floating
    own = np.zeros_like(y)
    own[:, first:] = samples.effort
    parameters.model.fold_followers(own)
    needed = K[:, first:, : parameters.inertial] @ parameters.load_reference
    load: FloatArray = np.abs(np.nan_to_num(needed - (y - own)[:, first:]))
    return load * sliding_column(samples)


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


def equation_of_motion(parameters: ParameterSet, samples: Samples) -> Rows:
    """Return the rows of K φ = y for a block of samples.

    Known joint terms (:attr:`ParameterSet.known_terms`) and payloads are subtracted from y.
    Unmeasured contact wrenches (:attr:`RobotModel.contacts`) are eliminated.
    """
    model = parameters.model
    first_joint = 6 * model.floating
    joints = JointTable.of(model.joints)
    # δ_j(l) of Eq. 10, column by column: only links that a joint carries load it.
    carries = np.repeat(joints.path[parameters.links].T, 10, axis=1)
    K = np.empty((len(samples), model.dof, len(parameters)))
    y = np.empty((len(samples), model.dof))
    for part in cache_blocks(len(samples), len(model.links)):
        block = samples[part]
        posture = Posture.at(joints, component_first(block.position))
        axes = sample_first(posture.motion_axes)
        inertial = K[part, :, : parameters.inertial]
        shape = (len(block), 6, parameters.inertial)
        wrenches = inertial[:, :6] if model.floating else np.empty(shape)
        wrenches[:] = _link_wrenches(parameters, posture, block)
        rows = inertial[:, first_joint:]
        np.matmul(np.ascontiguousarray(axes), wrenches, out=rows)
        rows *= carries
        y[part] = generalised_force(model, block, posture.poses, axes)
    if len(parameters) > parameters.inertial:
        _fill_joint_terms(K, parameters, samples)
    model.fold_followers(K)
    for payload in parameters.payloads:
        carried = (samples.stamp >= payload.start) & (samples.stamp < payload.stop)
        column = 10 * int(np.searchsorted(parameters.links, payload.link))
        y -= carried[:, None] * (K[:, :, column : column + 10] @ payload.phi)
    if "load" in parameters.terms and model.contacts is None:  # else the load is unknown
        columns = parameters.term_columns["load"]
        factor = load_column(parameters, samples, K, y)[:, parameters.joints]
        K[:, first_joint + parameters.joints, range(columns.start, columns.stop)] = factor
    if parameters.known_terms:
        y -= known_force(parameters, samples)
    if model.contacts is not None:
        both = np.concatenate([K, y[..., None]], axis=2)
        (both,) = without_contacts(model, samples.position, both, touching=samples.touching)
        K, y = both[..., :-1], both[..., -1]
    return Rows(K, y)


def known_force(parameters: ParameterSet, samples: Samples) -> FloatArray:
    """Return the generalised force (N, n) of known friction and armature, zero at the base."""
    content = _joint_terms(parameters, samples)
    force = np.zeros((len(samples), parameters.model.dof))
    joints = force[:, 6 * parameters.model.floating :]
    for term, values in parameters.known_terms.items():
        joints += values * content[term]
    parameters.model.fold_followers(force)
    return force


def _link_wrenches(parameters: ParameterSet, posture: Posture, samples: Samples) -> FloatArray:
    """Return bX_l^F A_l (N, 6, inertial), Eq. 11 and 14: wrenches per unit parameter."""
    base = (
        component_first(samples.base_angular_velocity),
        component_first(samples.base_angular_acceleration),
        component_first(samples.base_specific_force),
    )
    rates = component_first(samples.velocity), component_first(samples.acceleration)
    motion = link_motion(posture, *rates, base)
    pose_acceleration = np.empty_like(posture.pose)
    rotation_acceleration = pose_acceleration[:, :3]
    np.einsum(
        "ikln,kjln->ijln", motion.lever_acceleration, posture.rotation, out=rotation_acceleration
    )
    pose_acceleration[:, 3] = motion.specific_force
    return body_integrals(parameters, posture.pose, pose_acceleration)


def _fill_joint_terms(K: FloatArray, parameters: ParameterSet, samples: Samples) -> None:
    """Write the columns of joint terms and sensor offsets, each joint's into its own row."""
    content = _joint_terms(parameters, samples)
    joints, first = parameters.joints, 6 * parameters.model.floating
    K[:, :, parameters.inertial :] = 0.0
    for term, columns in parameters.term_columns.items():
        if term in content:
            factor = np.broadcast_to(content[term], samples.velocity.shape)
            K[:, first + joints, range(columns.start, columns.stop)] = factor[:, joints]
    for coupling, coupled in parameters.coupling_columns.items():
        content = _coupled_terms(parameters, coupling, samples)
        for joint, ratio in zip(coupling.joints, coupling.ratios, strict=True):
            if joint in parameters.link_side:
                continue
            for term, column in coupled.items():
                K[:, first + joint, column] = ratio * content[term]
    for ripple, columns in parameters.ripple_columns.items():
        K[:, first + ripple.joint, columns] = ripple.columns(samples.position)
    offset = parameters.sensor_offsets.start
    for place in parameters.model.wrist_sensors.values():
        # The effort of these joints is minus the reading, which contains the offset.
        K[:, range(first + place.start, first + place.stop), range(offset, offset + 6)] = -1.0
        offset += 6


def _joint_terms(parameters: ParameterSet, samples: Samples) -> dict[Term, FloatArray]:
    """Return the factor (N, J) of each joint term that needs no force, extending Eq. 2.49.

    The armature is the inertia of rotor and gear reflected to the joint, and moves with q̇_j
    alone. As in MuJoCo, the rotor's motion with its link is neglected, because it is small
    compared to the geared motion (Featherstone 2008, sec. 9.6).
    """
    armature = samples.acceleration
    if parameters.link_side:
        armature = armature.copy()
        armature[:, parameters.link_side] = 0.0
    return {
        "viscous": samples.velocity,
        "coulomb": sliding_column(samples),
        "armature": armature,
        "offset": np.ones(1),
        "stribeck": stribeck_column(
            samples.velocity, parameters.model.joints, sliding_column(samples)
        ),
        "presliding": presliding_column(samples, parameters.model.joints),
    }


def _coupled_terms(
    parameters: ParameterSet, coupling: Coupling, samples: Samples
) -> dict[Term, FloatArray]:
    """Return the factor (N,) of each term of a coupled drive, a function of the drive's speed."""
    speed = coupling.speed(samples.velocity)
    joint = parameters.model.joints[coupling.joints[0]]
    return {
        "viscous": speed,
        "coulomb": coulomb_column(speed),
        "armature": coupling.speed(samples.acceleration),
        "stribeck": stribeck_column(speed[:, None], [joint])[:, 0],
    }


def slipping(parameters: ParameterSet, velocity: FloatArray) -> BoolArray:
    """Return which joints (N, J) slip together with all coupled drives that act on them."""
    slips = is_slipping(velocity)
    for place in parameters.model.wrist_sensors.values():
        slips[:, place] = True  # a sensor has no friction
    for coupling in parameters.couplings:
        slips[:, coupling.joints] &= is_slipping(coupling.speed(velocity))[:, None]
    return slips


def generalised_force(
    model: RobotModel, samples: Samples, poses: LinkPoses, axes: FloatArray
) -> FloatArray:
    """Return y = Sᵀ f_a + J_gᵀ f_e (N, n), Eq. 4, from efforts and measured wrenches.

    Parameters
    ----------
    model : RobotModel
        The robot.
    samples : Samples
        Efforts and wrenches.
    poses : LinkPoses
        Link poses of the samples.
    axes : (N, J, 6) float64
        Joint axes from :func:`symbid_ros.dynamics.kinematics.joint_axes`.
    """
    first_joint = 6 * model.floating
    frames = samples.wrench_frames
    at_base = wrenches_at_base(model, samples.wrenches, frames, poses)
    carries = model.ancestors[:, [model.loaded_link(name) for name in frames]].astype(np.float64)
    joint_forces = component_first(axes) * (carries @ component_first(at_base))
    y = np.empty((len(samples), model.dof))
    if model.floating:
        y[:, :6] = at_base.sum(axis=1)
    y[:, first_joint:] = samples.effort + joint_forces.sum(axis=0).T
    model.fold_followers(y)
    return y


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
