"""Motion of the base from an IMU on any link (REP-145)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import (
    JointTable,
    Posture,
    cache_blocks,
    component_first,
    cross,
    link_motion,
    link_velocity,
    matvec,
)
from symbid_ros.model.frames import Frame
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
        base[:, :, part] = _base_motion(
            table,
            frame,
            [component_first(x[part][:, above]) for x in joints],
            [component_first(x[part]) for x in readings],
        )
    return BaseMotion(*(motion.T for motion in base))


def _base_motion(
    table: JointTable,
    frame: Frame,
    joints: Sequence[FloatArray],
    readings: Sequence[FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the base's ω, ω̇ and specific force (3, N).

    The motion of the joints is (J, N), the same three readings of the IMU are (3, N) in its axes.
    """
    position, velocity, acceleration = joints
    imu_omega, imu_alpha, imu_force = readings
    # The IMU's motion relative to the base, in base axes.
    posture = Posture.at(table, position)
    rest = np.zeros((3, position.shape[1]))
    motion = link_motion(posture, velocity, acceleration, (rest, rest, rest))
    omega, alpha = motion.angular_velocity[:, -1], motion.angular_acceleration[:, -1]
    link_axes = posture.rotation[:, :, -1]
    lever = matvec(link_axes, frame.translation[:, None])
    swing = cross(omega, lever)
    arm = posture.position[:, -1] + lever
    arm_rate = link_velocity(posture, velocity, rest, rest)[1][:, -1] + swing
    arm_acceleration = motion.specific_force[:, -1] + cross(alpha, lever) + cross(omega, swing)

    to_base = np.einsum("ikn,kj->ijn", link_axes, frame.rotation)
    base_omega = matvec(to_base, imu_omega) - omega
    base_alpha = matvec(to_base, imu_alpha) - alpha - cross(base_omega, omega)
    base_force = (
        matvec(to_base, imu_force)
        - arm_acceleration
        - cross(base_alpha, arm)
        - cross(base_omega, cross(base_omega, arm) + 2 * arm_rate)
    )
    return base_omega, base_alpha, base_force
