"""The robot's sensors: readings computed from true quantities."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

import mujoco
import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.simulation.plant import SCALAR_LAST, State, Truth
from symbid_ros.simulation.systematic_errors import SystematicErrors


@dataclass(frozen=True)
class BalanceFeedback:
    """Joint states and IMU data of one instant, enough to balance.

    Joint arrays follow the model's joint order.

    Attributes
    ----------
    stamp : int
        Simulated time, ns.
    joint_position, joint_velocity : (J,) float64
        rad and rad/s.
    imu_orientation : (4,) float64
        Quaternion xyzw of the IMU frame in the world.
    imu_angular_velocity : (3,) float64
        In the IMU's axes, rad/s.
    """

    stamp: int
    joint_position: FloatArray
    joint_velocity: FloatArray
    imu_orientation: FloatArray
    imu_angular_velocity: FloatArray


@dataclass(frozen=True)
class Measurement(BalanceFeedback):
    """All sensor readings of one instant.

    Attributes
    ----------
    joint_effort : (J,) float64
        Nm.
    imu_linear_acceleration : (3,) float64
        Specific force (REP-145) in the IMU's axes, m/s².
    wrenches : (F, 6) float64
        (force; torque) of the environment on the robot at each wrench sensor, in the sensor
        frame's axes about its origin.
    """

    joint_effort: FloatArray
    imu_linear_acceleration: FloatArray
    wrenches: FloatArray


@dataclass(frozen=True)
class Instant(Measurement):
    """Sensor readings and true motion of one instant.

    Attributes
    ----------
    true_position, true_velocity, true_acceleration, true_effort : (J,) float64
        True joint state and applied torques.
    base_position : (3,) float64
        World position of the base origin.
    base_orientation : (4,) float64
        Quaternion xyzw of the base in the world.
    base_linear_velocity, base_angular_velocity : (3,) float64
        Relative to the world, in base axes.
    base_linear_acceleration, base_angular_acceleration : (3,) float64
        Coordinate acceleration of the base origin (without gravity) and angular acceleration,
        in base axes.
    """

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


BLOCK = 1024  # instants; drawing the noise of one instant at a time takes several times as long
SCALAR_FIRST = np.array([3, 0, 1, 2])
JOINTS, IMU, PLATES = 0, 1, 2  # indices in SystematicErrors.delays


class ChannelNoise(Protocol):
    """Standard deviations of the noise of all channels."""

    def by_channel(self, joints: int, wrenches: int) -> FloatArray:
        """Return the values of 3 J + 6 + 6 F channels: joints, IMU, wrenches."""
        ...


class Sensors:
    """Encoders, torque sensors, IMU and wrench sensors with systematic errors and white noise.

    Each reading is delayed, changed by its systematic error, made noisy and rounded, in this
    order. The noise has its own random generator and does not influence the plant: runs with
    different noise or errors have the same motion.

    Parameters
    ----------
    driven : (J,) bool
        Whether each joint has a drive; the others have no torque sensor and report 0.
    wrench_count : int
        Number of wrench sensors, force plates first. Sensors after the plates have noise but no
        systematic errors.
    noise : ChannelNoise or None
        Standard deviations of white Gaussian noise; None for sensors without noise.
    seed : int
        Seed of the noise.
    errors : SystematicErrors
        Errors of the J joints, the IMU and the plates.
    """

    def __init__(
        self,
        driven: BoolArray,
        wrench_count: int,
        noise: ChannelNoise | None,
        seed: int,
        errors: SystematicErrors,
    ) -> None:
        joints = len(driven)
        sizes = [joints, joints, joints, 3, 3, 6 * wrench_count]
        ends = np.cumsum(sizes).tolist()
        self._fields = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._sigma: FloatArray | None = None
        if noise is not None:
            self._sigma = noise.by_channel(joints, wrench_count)
            self._sigma[self._fields[2]] *= driven
        self._random = np.random.default_rng(seed)
        self._noise = np.zeros((0, ends[-1]))
        self._next = 0
        self._encoder_offset, self._torque_gain = errors.encoder_offset, 1.0 + errors.torque_gain
        self._wrench_offset = errors.wrench_offset
        self._plate_matrices = _plate_matrices(errors)
        self._mounting = np.array([1.0, 0.0, 0.0, 0.0])  # wxyz from the IMU's axes to its frame
        mujoco.mju_quatIntegrate(self._mounting, errors.imu_mounting, 1.0)
        mounting = np.zeros(9)
        mujoco.mju_quat2Mat(mounting, self._mounting)
        self._imu_axes = mounting.reshape(3, 3)
        self._drift = errors.drift
        self._drifts = bool(errors.drift.any())
        steps = errors.quantisation
        self._steps = (
            np.zeros(0) if steps is None else steps.by_channel(joints, len(self._wrench_offset))
        )
        self._delays = errors.delays.tolist()
        self._past: deque[Truth] = deque(maxlen=1 + math.ceil(max(self._delays)))

    def store(self, truth: Truth) -> None:
        """Store an instant, which delayed sensors will report later."""
        self._past.append(truth)

    def measure(self, truth: Truth, stamp: int) -> Instant:
        """Return readings and truth of one instant with a stamp in nanoseconds."""
        self.store(truth)
        state = truth.state
        velocity, acceleration = state.velocity, truth.acceleration
        imu = self._delayed(IMU)
        readings = np.concatenate(
            [
                *self._joint_readings(self._delayed(JOINTS)),
                (imu.imu_motion.reshape(2, 3) @ self._imu_axes).ravel(),
                self._wrench_readings(truth).ravel(),
            ]
        )
        if self._drifts:
            self._add_drift(readings, 1e-9 * stamp)
        if self._sigma is not None:
            readings += self._next_noise(self._sigma)
        if len(self._steps):
            rounded = readings[: len(self._steps)]
            rounded[:] = self._steps * np.rint(rounded / self._steps)
        position, rate, effort, gyroscope, accelerometer, wrenches = [
            readings[field] for field in self._fields
        ]
        to_world = truth.base_rotation
        return Instant(
            stamp=stamp,
            joint_position=position,
            joint_velocity=rate,
            joint_effort=effort,
            imu_orientation=self._orientation(imu.imu_orientation),
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

    def _delayed(self, sensor: int) -> Truth:
        """Return the past instant that a sensor reports now, interpolated between two."""
        age = min(self._delays[sensor], len(self._past) - 1)
        later = self._past[len(self._past) - 1 - math.floor(age)]
        share = age % 1.0
        if not share:
            return later
        return _interpolated(later, self._past[len(self._past) - 1 - math.ceil(age)], share)

    def _joint_readings(self, truth: Truth) -> tuple[FloatArray, FloatArray, FloatArray]:
        return (
            truth.state.position[7:] + self._encoder_offset,
            truth.state.velocity[6:],
            truth.effort * self._torque_gain,
        )

    def _wrench_readings(self, truth: Truth) -> FloatArray:
        readings = truth.wrenches.copy()
        for plate, matrix in enumerate(self._plate_matrices):
            np.dot(matrix, self._delayed(PLATES + plate).wrenches[plate], readings[plate])
        readings[: len(self._wrench_offset)] += self._wrench_offset
        return readings

    def _add_drift(self, readings: FloatArray, time: float) -> None:
        """Add to all readings what the offsets of plates and IMU have changed in ``time``, s."""
        drift, last = self._drift, len(self._drift) - 1
        second = min(int(time), last)
        share = time - second if second < last else 0.0
        now = drift[second] + share * (drift[min(second + 1, last)] - drift[second])
        gyroscope, wrenches = self._fields[3].start, self._fields[5].start
        readings[gyroscope:wrenches] += now[-6:]
        readings[wrenches : wrenches + len(now) - 6] += now[:-6]

    def _orientation(self, quaternion: FloatArray) -> FloatArray:
        """Return the orientation (xyzw) of the IMU's axes from the orientation of its frame."""
        mounted = np.zeros(4)
        mujoco.mju_mulQuat(mounted, quaternion.take(SCALAR_FIRST), self._mounting)
        return mounted.take(SCALAR_LAST)

    def _next_noise(self, sigma: FloatArray) -> FloatArray:
        if self._next == len(self._noise):
            self._noise = self._random.standard_normal((BLOCK, len(sigma))) * sigma
            self._next = 0
        self._next += 1
        noise: FloatArray = self._noise[self._next - 1]
        return noise


def _interpolated(later: Truth, earlier: Truth, share: float) -> Truth:
    """Return the joint, IMU and wrench readings between two instants."""

    def between(after: FloatArray, before: FloatArray) -> FloatArray:
        return (1.0 - share) * after + share * before

    state = State(
        later.state.time - share * (later.state.time - earlier.state.time),
        between(later.state.position, earlier.state.position),
        between(later.state.velocity, earlier.state.velocity),
    )
    orientation = between(later.imu_orientation, earlier.imu_orientation)
    return replace(
        later,
        state=state,
        effort=between(later.effort, earlier.effort),
        imu_orientation=orientation / np.linalg.norm(orientation),
        imu_motion=between(later.imu_motion, earlier.imu_motion),
        wrenches=between(later.wrenches, earlier.wrenches),
    )


def _plate_matrices(errors: SystematicErrors) -> FloatArray:
    """Return the matrices (F, 6, 6) from true (force; moment) to readings without offset."""
    matrices = np.tile(np.eye(6), (len(errors.wrench_gain), 1, 1))
    # n' = n - d × f: the moment about a point at distance d from the frame's origin.
    matrices[:, 3:, :3] = -np.cross(errors.wrench_position[:, None], np.eye(3)).swapaxes(1, 2)
    return np.asarray(errors.wrench_gain[:, :, None] * matrices + matrices)
