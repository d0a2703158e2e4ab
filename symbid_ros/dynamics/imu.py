"""Motion of the base from an IMU on any link (REP-145)."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import JointTable, Posture, link_motion, link_velocity
from symbid_ros.dynamics.spatial import cache_blocks, component_first, cross, matvec
from symbid_ros.model.tree import Frame, RobotModel


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
    """Transform IMU readings to the base.

    Parameters
    ----------
    model : RobotModel
        The robot.
    frame_name : str
        The IMU's frame, on any link.
    joints : tuple of (N, J) float64
        Joint positions, velocities and accelerations.
    imu : BaseMotion
        The same three quantities measured by the IMU, in its own axes.

    Returns
    -------
    BaseMotion
        The IMU's motion without that of its link relative to the base and without the effect of
        the lever arm, ω̇×r + ω×(ω×r) + 2ω×ṙ.
    """
    frame = model.frame(frame_name)
    above = np.flatnonzero(model.ancestors[:, frame.link])
    # Only the joints between base and IMU matter. They form a serial chain.
    table = JointTable.of([replace(model.joints[j], parent=k) for k, j in enumerate(above)])
    readings = (imu.angular_velocity, imu.angular_acceleration, imu.specific_force)
    base = np.empty((3, 3, len(joints[0])))
    for part in cache_blocks(len(joints[0]), len(table) + 1):
        position, velocity, acceleration = (component_first(x[part][:, above]) for x in joints)
        mount = _imu_with_base_at_rest(table, frame, (position, velocity, acceleration))
        base[:, :, part] = _remove_mount(mount, *(component_first(x[part]) for x in readings))
    return BaseMotion(*(motion.T for motion in base))


@dataclass(frozen=True)
class _Mount:
    """Motion of the IMU's frame relative to the base, in base axes.

    Attributes
    ----------
    rotation : (3, 3, N) float64
        From IMU axes to base axes.
    arm, velocity, acceleration : (3, N) float64
        Position of the IMU in m and its derivatives.
    omega, alpha : (3, N) float64
        Angular velocity and acceleration of the IMU.
    """

    rotation: FloatArray
    arm: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    omega: FloatArray
    alpha: FloatArray


def _imu_with_base_at_rest(
    table: JointTable, frame: Frame, joints: tuple[FloatArray, FloatArray, FloatArray]
) -> _Mount:
    """Return the IMU's motion from joint positions, velocities and accelerations (J, N) alone."""
    position, velocity, acceleration = joints
    posture = Posture.at(table, position)
    rest = np.zeros((3, position.shape[1]))
    motion = link_motion(posture, velocity, acceleration, (rest, rest, rest))
    _, linear = link_velocity(posture, velocity, rest, rest)
    omega, alpha = motion.angular_velocity[:, -1], motion.angular_acceleration[:, -1]
    link_axes = posture.rotation[:, :, -1]
    lever = matvec(link_axes, frame.translation[:, None])
    swing = cross(omega, lever)
    return _Mount(
        rotation=np.einsum("ikn,kj->ijn", link_axes, frame.rotation),
        arm=posture.position[:, -1] + lever,
        velocity=linear[:, -1] + swing,
        acceleration=motion.specific_force[:, -1] + cross(alpha, lever) + cross(omega, swing),
        omega=omega,
        alpha=alpha,
    )


def _remove_mount(
    mount: _Mount, omega: FloatArray, alpha: FloatArray, force: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the base's ω, ω̇ and specific force (3, N) from the IMU's readings in IMU axes."""
    base_omega = matvec(mount.rotation, omega) - mount.omega
    base_alpha = matvec(mount.rotation, alpha) - mount.alpha - cross(base_omega, mount.omega)
    swing = cross(base_omega, mount.arm) + 2 * mount.velocity
    base_force = (
        matvec(mount.rotation, force)
        - mount.acceleration
        - cross(base_alpha, mount.arm)
        - cross(base_omega, swing)
    )
    return base_omega, base_alpha, base_force
