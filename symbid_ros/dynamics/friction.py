"""Friction of joints: the columns of its terms, and the speeds at which a joint slips.

Each column is a function of the joint's own motion, and linear in its parameter (Eq. 2.49).
"""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint

# Speeds and travels of friction, of revolute and of prismatic joints: rad/s and m/s, rad and m.
# They are equal at a distance of 0.1 m from the axis.
#
# Below this speed a joint may stick, and static friction balances the other forces.
COULOMB_SPEED = 0.02, 0.002
# Speed below which the column of Coulomb friction is a ramp.
COULOMB_RAMP = 4e-3, 4e-4
# Speed at which Stribeck friction has fallen to 1/e.
STRIBECK_SPEED = 0.2, 0.02
# Travel after a reversal within which friction builds up to 63 %, in presliding: about the
# hysteresis of a strain wave gear.
PRESLIDING_TRAVEL = 2e-3, 2e-4
# Time, s, by which friction leads: dmax timeconst / 2 of MuJoCo's default solimpfriction and
# solreffriction.
LEAD_TIME = 0.0095
# Speed up to which the friction of light joints in MuJoCo may creep: (1 - d) timeconst dmax / (2 d)
# times friction over inertia, with its default impedance d of 0.9, is 1.06 ms times 47 rad/s².
CREEP_SPEED = 0.05, 0.005


def is_slipping(velocity: FloatArray, joints: Sequence[Joint]) -> BoolArray:
    """Return whether joints (N, J) move at ``COULOMB_SPEED`` or faster.

    Friction in a sticking joint takes any value up to ± its Coulomb friction, so the joint's row
    of the equation of motion is valid only while the joint slips.
    """
    moves: BoolArray = np.abs(velocity) >= by_kind(COULOMB_SPEED, joints)
    return moves


def coulomb_column(velocity: FloatArray, joints: Sequence[Joint]) -> FloatArray:
    """Return sign(q̇) (N, J) of Eq. 2.49, with a linear ramp below ``COULOMB_RAMP``.

    Without the ramp, noise about zero speed would switch the friction's sign. The ramp does not
    model stiction. It ends far below ``COULOMB_SPEED``: a window of a slipping joint may contain a
    few slower samples, and a column of less than one there would bias the friction.
    """
    column: FloatArray = np.clip(velocity / by_kind(COULOMB_RAMP, joints), -1.0, 1.0)
    return column


def sliding_column(samples: Samples, joints: Sequence[Joint]) -> FloatArray:
    """Return :func:`coulomb_column` (N, J) of samples, filtered if they are."""
    return coulomb_column(samples.velocity, joints) if samples.sliding is None else samples.sliding


def stribeck_column(
    velocity: FloatArray, joints: Sequence[Joint], sliding: FloatArray | None = None
) -> FloatArray:
    """Return sign(q̇) exp(-|q̇|/v) (N, J), how friction falls with speed after a joint breaks away.

    With a fixed speed v the column is linear in its parameter (Bona and Indri 2005, Proc. 44th
    IEEE CDC). Together with Coulomb and viscous friction it also represents viscous friction that
    saturates with speed, as that of harmonic drives.
    """
    speed = by_kind(STRIBECK_SPEED, joints)
    if sliding is None:
        sliding = coulomb_column(velocity, joints)
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
    gain[1:] = np.exp(-np.abs(step) / by_kind(PRESLIDING_TRAVEL, joints))
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
        share = 1 - 2 * np.exp(-distance / by_kind(PRESLIDING_TRAVEL, joints))
        state = np.sign(velocity) * share
    column: FloatArray = state - sliding_column(samples, joints)
    return column


def lead_column(samples: Samples, joints: Sequence[Joint]) -> FloatArray:
    """Return sign(q̇ + t q̈) - sign(q̇) (N, J), by which friction reverses ahead of the joint.

    MuJoCo's friction loss is a soft constraint, which tries to reach q̈ = -q̇/t: a joint that brakes
    harder is driven by its friction (MuJoCo documentation, Computation, Constraint model).
    """
    column: FloatArray = _leading(samples, joints) - sliding_column(samples, joints)
    return column


def creep_column(samples: Samples, joints: Sequence[Joint]) -> FloatArray:
    """Return r - sign(q̇ + t q̈) (N, J), by how much friction is less while a joint creeps.

    r rises from -1 to 1 between ∓ ``CREEP_SPEED``. MuJoCo's friction loss is in proportion to
    q̇ + t q̈ up to a speed in proportion to its size over the inertia of the joint. With as much
    Coulomb friction this is that speed; with less, the friction rises faster.
    """
    slow = samples.creeping
    if slow is None:
        slow = creeping_column(samples.velocity, samples.acceleration, joints)
    column: FloatArray = slow - _leading(samples, joints)
    return column


def _leading(samples: Samples, joints: Sequence[Joint]) -> FloatArray:
    if samples.leading is not None:
        return samples.leading
    return leading_column(samples.velocity, samples.acceleration, joints)


def creeping_column(
    velocity: FloatArray, acceleration: FloatArray, joints: Sequence[Joint]
) -> FloatArray:
    """Return the ramp (N, J) of q̇ + t q̈ between ∓ ``CREEP_SPEED``, from -1 to 1."""
    ahead = velocity + LEAD_TIME * acceleration
    column: FloatArray = np.clip(ahead / by_kind(CREEP_SPEED, joints), -1.0, 1.0)
    return column


def leading_column(
    velocity: FloatArray, acceleration: FloatArray, joints: Sequence[Joint]
) -> FloatArray:
    """Return sign(q̇ + t q̈) (N, J), with the ramp of :func:`coulomb_column`."""
    return coulomb_column(velocity + LEAD_TIME * acceleration, joints)


def by_kind(values: tuple[float, float], joints: Sequence[Joint]) -> FloatArray:
    """Return a value (J,) for each joint, given one for revolute and one for prismatic joints."""
    return np.array([values[joint.kind == "prismatic"] for joint in joints])


def load_column(
    parameters: ParameterSet, samples: Samples, needed: FloatArray, y: FloatArray
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
    needed : (N, n) float64
        Generalised force of the reference inertias.
    y : (N, n) float64
        Generalised force, from which that of the efforts is subtracted.
    """
    first = 6 * parameters.model.floating
    own = np.zeros_like(y)
    own[:, first:] = samples.effort
    parameters.model.fold_followers(own)
    load: FloatArray = np.abs(np.nan_to_num((needed - (y - own))[:, first:]))
    return load * sliding_column(samples, parameters.model.joints)


def slipping(parameters: ParameterSet, velocity: FloatArray) -> BoolArray:
    """Return which joints (N, J) slip together with all coupled drives that act on them."""
    joints = parameters.model.joints
    slips = is_slipping(velocity, joints)
    for place in parameters.model.wrist_sensors.values():
        slips[:, place] = True  # a sensor has no friction
    for coupling in parameters.couplings:
        own = [joints[coupling.joints[0]]]
        slips[:, coupling.joints] &= is_slipping(coupling.speed(velocity)[:, None], own)
    return slips
