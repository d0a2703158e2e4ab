"""The equation of motion, linear in the parameters: K φ = y (Eq. 6, 10–14, 2.46–2.49)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkMotion, LinkPoses, joint_axes, link_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import cross, inertia_action, rotate, skew
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class Rows:
    """N samples of the equation of motion.

    Attributes
    ----------
    K : (N, n, p) float64
        Regressor. Base rows first: moment, then force, in base axes at the base's
        origin; then one row per joint.
    y : (N, n) float64
        Generalised force of motors and environment, Nm and N.
    """

    K: FloatArray
    y: FloatArray


def equation_of_motion(parameters: ParameterSet, samples: Samples) -> Rows:
    """Return the rows of K φ = y for a block of samples."""
    model = parameters.model
    motion = link_motion(model, samples)
    axes = joint_axes(model, motion.poses)
    K = np.zeros((len(samples), model.dof, len(parameters)))
    _fill_inertial(K, parameters, motion, axes)
    if parameters.friction:
        _fill_friction(K, parameters, samples.velocity)
    return Rows(K, generalised_force(model, samples, motion.poses, axes))


def _fill_inertial(
    K: FloatArray, parameters: ParameterSet, motion: LinkMotion, axes: FloatArray
) -> None:
    """Write Eq. 10 for every link: its wrench at the base, seen by each joint below it."""
    model = parameters.model
    first_joint = 6 * model.floating
    for position, link in enumerate(parameters.links):
        columns = slice(10 * position, 10 * position + 10)
        wrench = _link_wrench_at_base(motion, int(link))
        if model.floating:
            K[:, :6, columns] = wrench
        above = np.flatnonzero(model.ancestors[:, link])
        K[:, first_joint + above, columns] = axes[:, above] @ wrench


def _link_wrench_at_base(motion: LinkMotion, link: int) -> FloatArray:
    """Return bX_l^F A_l (N, 6, 10), Eq. 11 and 14: a link's wrench per unit parameter.

    The moment block of m·c is -S(p̈), not the thesis's -S(ṗ) of Eq. 2.38.
    """
    omega, alpha = motion.angular_velocity[:, link], motion.angular_acceleration[:, link]
    force = motion.specific_force[:, link]
    spin = skew(omega)
    A = np.zeros((len(omega), 6, 10))
    A[:, :3, 1:4] = -skew(force)
    A[:, :3, 4:] = inertia_action(alpha) + spin @ inertia_action(omega)
    A[:, 3:, 0] = force
    A[:, 3:, 1:4] = skew(alpha) + spin @ spin
    rotation, position = motion.poses.rotation[:, link], motion.poses.position[:, link]
    at_base = np.empty_like(A)
    at_base[:, 3:] = rotation @ A[:, 3:]
    at_base[:, :3] = rotation @ A[:, :3] + skew(position) @ at_base[:, 3:]
    return at_base


def _fill_friction(K: FloatArray, parameters: ParameterSet, velocity: FloatArray) -> None:
    """Write Eq. 2.49: viscous columns q̇ and Coulomb columns sign(q̇)."""
    joints = np.arange(velocity.shape[1])
    rows, viscous = K.shape[1] - len(joints) + joints, parameters.inertial + joints
    K[:, rows, viscous] = velocity
    K[:, rows, viscous + len(joints)] = np.sign(velocity)


def generalised_force(
    model: RobotModel, samples: Samples, poses: LinkPoses, axes: FloatArray
) -> FloatArray:
    """Return y = Sᵀ f_a + J_gᵀ f_e (N, n), Eq. 4, of motors and measured wrenches.

    Parameters
    ----------
    model : RobotModel
        The robot.
    samples : Samples
        Efforts and wrenches.
    poses : LinkPoses
        Of the same samples.
    axes : (N, J, 6) float64
        From :func:`symbid_ros.dynamics.kinematics.joint_axes`.
    """
    first_joint = 6 * model.floating
    y = np.zeros((len(samples), model.dof))
    y[:, first_joint:] = samples.effort
    at_base = wrenches_at_base(model, samples.wrenches, samples.wrench_frames, poses)
    for sensor, name in enumerate(samples.wrench_frames):
        if model.floating:
            y[:, :6] += at_base[:, sensor]
        above = np.flatnonzero(model.ancestors[:, model.frame(name).link])
        y[:, first_joint + above] += (axes[:, above] @ at_base[:, sensor, :, None])[..., 0]
    return y


def wrenches_at_base(
    model: RobotModel, wrenches: FloatArray, frames: Sequence[str], poses: LinkPoses
) -> FloatArray:
    """Return wrenches (N, F, 6) of sensor frames moved to the base's axes and origin."""
    at_base = np.empty_like(wrenches)
    for sensor, name in enumerate(frames):
        frame = model.frame(name)
        to_base = poses.rotation[:, frame.link]
        rotation = to_base @ frame.rotation
        origin = poses.position[:, frame.link] + rotate(to_base, frame.translation)
        force = rotate(rotation, wrenches[:, sensor, 3:])
        at_base[:, sensor, 3:] = force
        at_base[:, sensor, :3] = rotate(rotation, wrenches[:, sensor, :3]) + cross(origin, force)
    return at_base
