"""What one simulated instant looks like, true and as the sensors say."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Instant:
    """One millisecond of the robot, every field of the same instant.

    ``Sensor*`` topics are made of the first group, ``ground_truth/`` of the second.
    Joint arrays follow the model's joint order; quaternions are xyzw.

    Attributes
    ----------
    stamp : int
        Simulated time in nanoseconds.
    joint_position, joint_velocity, joint_effort : (J,) float64
        As measured (noise included unless the sensors are ideal).
    imu_orientation : (4,) float64
        Quaternion xyzw of the IMU frame in the world.
    imu_angular_velocity, imu_linear_acceleration : (3,) float64
        In the IMU frame; the acceleration is the specific force (REP-145).
    wrenches : (F, 6) float64
        Per wrench sensor (force; torque), environment on robot, in the
        sensor frame's axes about its origin.
    true_position, true_velocity, true_acceleration, true_effort : (J,) float64
        True joint state and applied torques.
    base_position : (3,) float64
        World position of the base origin.
    base_orientation : (4,) float64
        Quaternion xyzw of the base in the world.
    base_linear_velocity, base_angular_velocity : (3,) float64
        Relative to the world, in base axes.
    base_linear_acceleration, base_angular_acceleration : (3,) float64
        Coordinate acceleration of the base origin (no gravity in it) and
        angular acceleration, in base axes.
    """

    stamp: int
    joint_position: FloatArray
    joint_velocity: FloatArray
    joint_effort: FloatArray
    imu_orientation: FloatArray
    imu_angular_velocity: FloatArray
    imu_linear_acceleration: FloatArray
    wrenches: FloatArray
    true_position: FloatArray
    true_velocity: FloatArray
    true_acceleration: FloatArray
    true_effort: FloatArray
    base_position: FloatArray
    base_orientation: FloatArray
    base_linear_velocity: FloatArray
    base_angular_velocity: FloatArray
    base_linear_acceleration: FloatArray
    base_angular_acceleration: FloatArray
