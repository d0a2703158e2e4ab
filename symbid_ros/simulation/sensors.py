"""From true quantities to what the robot's sensors report."""

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.simulation.measurement import Instant
from symbid_ros.simulation.noise import SensorNoise
from symbid_ros.simulation.plant import SCALAR_LAST, Truth

# Drawing normal numbers one instant at a time costs several times as much.
BLOCK = 1024


class Sensors:
    """Encoders, torque sensors, IMU and wrench sensors with additive white noise.

    The noise has a random generator of its own and nothing flows back to the plant, so that
    runs with other noise, or none, are runs of the same motion.

    Parameters
    ----------
    driven : (J,) bool
        Which joints have a drive; the others have no torque sensor and report 0.
    wrench_count : int
        Number of wrench sensors.
    noise : SensorNoise or None
        Standard deviations; None for ideal sensors.
    seed : int
        Seed of the noise.
    """

    def __init__(
        self, driven: BoolArray, wrench_count: int, noise: SensorNoise | None, seed: int
    ) -> None:
        joints = len(driven)
        sizes = [joints, joints, joints, 3, 3, 6 * wrench_count]
        ends = np.cumsum(sizes).tolist()
        self._fields = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._sigma: FloatArray | None = None
        if noise is not None:
            wrench = np.repeat([noise.force, noise.moment], 3)
            self._sigma = np.concatenate(
                [
                    np.full(joints, noise.joint_position),
                    np.full(joints, noise.joint_velocity),
                    np.where(driven, noise.joint_effort, 0.0),
                    np.full(3, noise.angular_velocity),
                    np.full(3, noise.linear_acceleration),
                    np.tile(wrench, wrench_count),
                ]
            )
        self._random = np.random.default_rng(seed)
        self._errors = np.zeros((0, ends[-1]))
        self._next = 0

    def measure(self, truth: Truth, stamp: int) -> Instant:
        """Return one instant: readings and truth, stamped in nanoseconds."""
        state = truth.state
        velocity, acceleration = state.velocity, truth.acceleration
        readings = np.concatenate(
            [
                state.position[7:],
                velocity[6:],
                truth.effort,
                truth.imu_motion,
                truth.wrenches.ravel(),
            ]
        )
        if self._sigma is not None:
            readings += self._error(self._sigma)
        position, rate, effort, gyroscope, accelerometer, wrenches = [
            readings[field] for field in self._fields
        ]
        to_world = truth.base_rotation
        return Instant(
            stamp=stamp,
            joint_position=position,
            joint_velocity=rate,
            joint_effort=effort,
            imu_orientation=truth.imu_orientation,
            imu_angular_velocity=gyroscope,
            imu_linear_acceleration=accelerometer,
            wrenches=wrenches.reshape(-1, 6),
            true_position=state.position[7:],
            true_velocity=velocity[6:],
            true_acceleration=acceleration[6:],
            true_effort=truth.effort,
            base_position=state.position[:3],
            base_orientation=state.position[3:7].take(SCALAR_LAST),
            base_linear_velocity=np.dot(velocity[:3], to_world),
            base_angular_velocity=velocity[3:6],
            base_linear_acceleration=np.dot(acceleration[:3], to_world),
            base_angular_acceleration=acceleration[3:6],
        )

    def _error(self, sigma: FloatArray) -> FloatArray:
        if self._next == len(self._errors):
            self._errors = self._random.standard_normal((BLOCK, len(sigma))) * sigma
            self._next = 0
        self._next += 1
        error: FloatArray = self._errors[self._next - 1]
        return error
