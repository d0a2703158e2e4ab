"""The base's motion, from an IMU mounted anywhere on the tree (REP-145)."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import joint_axes, link_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import cross, rotate
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class BaseMotion:
    """Motion of the base, each (N, 3), in base axes at the base's origin.

    ``angular_velocity`` in rad/s, ``angular_acceleration`` in rad/s² and
    ``specific_force``, acceleration minus gravity, in m/s².
    """

    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray


def base_motion(
    model: RobotModel,
    frame_name: str,
    joints: tuple[FloatArray, FloatArray, FloatArray],
    imu: BaseMotion,
) -> BaseMotion:
    """Carry the IMU's readings over to the base.

    Parameters
    ----------
    model : RobotModel
        The robot.
    frame_name : str
        The IMU's frame, on any link.
    joints : tuple of (N, J) float64
        Joint positions, velocities and accelerations.
    imu : BaseMotion
        The same three quantities as the IMU feels them, in its own axes.

    Returns
    -------
    BaseMotion
        The IMU's motion less that of its link relative to the base and less the
        lever arm's part ω̇×r + ω×(ω×r) + 2ω×ṙ.
    """
    frame = model.frame(frame_name)
    relative = _motion_with_base_at_rest(model, joints)
    motion = link_motion(model, relative)
    link_axes = motion.poses.rotation[:, frame.link]
    to_base = link_axes @ frame.rotation
    omega = rotate(link_axes, motion.angular_velocity[:, frame.link])
    alpha = rotate(link_axes, motion.angular_acceleration[:, frame.link])
    lever = rotate(link_axes, frame.translation)
    arm = motion.poses.position[:, frame.link] + lever
    acceleration = (
        rotate(link_axes, motion.specific_force[:, frame.link])
        + cross(alpha, lever)
        + cross(omega, cross(omega, lever))
    )
    axes = joint_axes(model, motion.poses)[:, model.ancestors[:, frame.link]]
    rates = relative.velocity[:, model.ancestors[:, frame.link]]
    twist = np.einsum("njc,nj->nc", axes, rates)
    velocity = twist[:, 3:] + cross(twist[:, :3], arm)

    base_omega = rotate(to_base, imu.angular_velocity) - omega
    base_alpha = rotate(to_base, imu.angular_acceleration) - alpha - cross(base_omega, omega)
    base_force = (
        rotate(to_base, imu.specific_force)
        - acceleration
        - cross(base_alpha, arm)
        - cross(base_omega, cross(base_omega, arm))
        - 2 * cross(base_omega, velocity)
    )
    return BaseMotion(base_omega, base_alpha, base_force)


def _motion_with_base_at_rest(
    model: RobotModel, joints: tuple[FloatArray, FloatArray, FloatArray]
) -> Samples:
    count = len(joints[0])
    nothing = np.zeros((count, 3))
    return Samples(
        stamp=np.zeros(count, dtype=np.int64),
        position=joints[0],
        velocity=joints[1],
        acceleration=joints[2],
        effort=np.zeros((count, len(model.joints))),
        base_angular_velocity=nothing,
        base_angular_acceleration=nothing,
        base_specific_force=nothing,
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )
