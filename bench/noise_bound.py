"""The least errors that the noise of sensors allows: Bayesian Cramér-Rao bounds.

Every channel is noisy at 1 kHz, nothing is filtered, and the motion is measured by encoders and IMU
alone. Their noise, differentiated as often as the equation of motion asks for, hides fast motion:
that of an encoder grows with the square of the frequency. Errors of the sensors and of the model's
geometry are further unknowns with columns of their own, at the true robot.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import (
    com_position,
    equation_of_motion,
    first_moment_regressor,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.predictions.evaluation import TrueMotion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.signals.calibrating_rows import LinearizationPoint, error_columns
from symbid_ros.signals.sensor_errors import SensorErrors
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.simulation.settings import ChannelValues, load_noise

FloatArray = NDArray[np.float64]
RATE = 1000.0  # Hz
BLOCK = 1024  # samples in which the posture counts as constant
EDGES = (0.0, 2.0, 10.0, 30.0, 100.0, 500.1)  # Hz
ALL = (0.0, 500.1)
IMU = "imu_link"
STEP = 1e-5
# Columns of sensors' errors change slowly: they are computed for one of so many samples.
SPARSE = 32
NO_ERRORS = SensorErrors((), (), (), (), np.zeros(0, dtype=bool))


def band_information(
    parameters: ParameterSet,
    motion: Samples,
    errors: SensorErrors = NO_ERRORS,
    size: ChannelValues | None = None,
    edges: tuple[float, ...] = EDGES,
) -> FloatArray:
    """Return the information (B, p + r, p + r) in each band of frequencies.

    Parameters
    ----------
    parameters : ParameterSet
        The true robot.
    motion : Samples
        The true motion, with forces.
    errors : SensorErrors
        The r further unknowns.
    size : ChannelValues, optional
        Deviations of the noise at 1 kHz; by default those of the simulator.
    edges : tuple of float
        Limits of the bands, Hz.
    """
    size = size or load_noise(config_file("noise.yaml"))
    count = len(parameters) + len(errors)
    total = np.zeros((len(edges) - 1, count, count))
    for start in range(0, len(motion) - BLOCK + 1, BLOCK // 2):
        block = motion[start : start + BLOCK]
        K = equation_of_motion(parameters, block).K
        if len(errors):
            K = np.concatenate([K, -sensor_columns(parameters, errors, block)], axis=2)
        total += information(K, RATE, sensor_noise(parameters, block, size), edges)
    return total


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a log besides the parameters, with their prior and the noise.

    Attributes
    ----------
    errors : SensorErrors
        The r unknowns besides the parameters.
    prior : Prior
        Of parameters, joint terms that may be absent, and errors.
    measurements : PseudoMeasurements or None
        Rows of the prior's parameters, such as a weighing and soles at rest.
    noise : ChannelValues
        Deviations at 1 kHz.
    """

    errors: SensorErrors
    prior: Prior
    measurements: PseudoMeasurements | None
    noise: ChannelValues


def bound_covariance(parameters: ParameterSet, motion: Samples, unknowns: Unknowns) -> FloatArray:
    """Return the covariance (p, p) that no estimator's errors fall below in the mean.

    Parameters
    ----------
    parameters : ParameterSet
        The true robot.
    motion : Samples
        The true motion, with forces.
    unknowns : Unknowns
    """
    errors, prior = unknowns.errors, unknowns.prior
    names = parameters.names + errors.names
    scale = prior.marginal(names).covariance_factor()
    (total,) = band_information(parameters, motion, errors, unknowns.noise, ALL)
    if unknowns.measurements is not None:
        rows = unknowns.measurements.rows[:, [prior.names.index(name) for name in names]]
        total = total + rows.T @ rows
    precision = np.eye(len(names)) + scale.T @ total @ scale
    root = np.linalg.solve(np.linalg.cholesky(precision), scale.T)[:, : len(parameters)]
    covariance: FloatArray = root.T @ root
    return covariance


def sensor_columns(parameters: ParameterSet, errors: SensorErrors, block: Samples) -> FloatArray:
    """Return the columns (N, n, r) of errors that are small, in a block of the true motion."""
    imu = ideal_imu(parameters, block)
    readings = SensorSamples(
        stamp=block.stamp,
        position=block.position,
        velocity=block.velocity,
        acceleration=block.acceleration,
        effort=block.effort,
        angular_velocity=imu.angular_velocity[:, None],
        angular_acceleration=imu.angular_acceleration[:, None],
        specific_force=imu.specific_force[:, None],
        wrenches=block.wrenches,
        imu_frames=(IMU,),
        wrench_frames=block.wrench_frames,
    )
    at = np.append(np.arange(0, len(block) - 1, SPARSE), len(block) - 1)
    point = LinearizationPoint(parameters.values, np.zeros(len(errors)))
    sparse = error_columns(parameters, errors, point, readings[at])
    columns: FloatArray = make_interp_spline(at, sparse, k=1)(np.arange(len(block)))
    return columns


def ideal_imu(parameters: ParameterSet, block: Samples) -> BaseMotion:
    """Return what an ideal IMU reads, with its angular acceleration."""
    frame = parameters.model.frame(IMU)
    omega, alpha = block.base_angular_velocity, block.base_angular_acceleration
    force = block.base_specific_force + np.cross(alpha, frame.translation)
    force = force + np.cross(omega, np.cross(omega, frame.translation))
    return BaseMotion(*(one @ frame.rotation for one in (omega, alpha, force)))


def information(
    K: FloatArray,
    rate: float,
    noise: Callable[[FloatArray], NDArray[np.complex128]],
    edges: tuple[float, ...],
) -> FloatArray:
    """Return the information (B, p, p) that half-overlapping blocks of the rows K φ = y add up to.

    Parameters
    ----------
    K : (N, n, p) float64
        Regressor of the true motion in one block. Its sine window, squared, adds up to one with
        those of its neighbours.
    rate : float
        Hz.
    noise : callable
        Maps frequencies (F,), Hz, to T (F, n, c): what c channels of white noise with a deviation
        of one at each sample do to the residual.
    edges : tuple of float
        Limits of the B bands, Hz.

    Notes
    -----
    Every channel, and with it the motion, is unknown but for one noisy reading at each instant.
    With the motion profiled out, the Fisher information is that of generalised least squares with
    the residual's covariance at the truth, T Tᴴ at each frequency.
    """
    count = len(K)
    window = np.sin(np.pi * (np.arange(count) + 0.5) / count)
    spectrum = np.fft.rfft(window[:, None, None] * K, axis=0)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    T = noise(frequency)
    factor = np.linalg.cholesky(count * T @ T.conj().transpose(0, 2, 1))
    white = np.linalg.solve(factor, spectrum)
    # Negative frequencies are the conjugates of the positive ones.
    white[1 : (count + 1) // 2] *= np.sqrt(2)
    parts = []
    for low, high in pairwise(edges):
        some = white[(frequency >= low) & (frequency < high)].reshape(-1, K.shape[2])
        stacked = np.vstack([some.real, some.imag])
        parts.append(stacked.T @ stacked)
    return np.stack(parts)


def sensor_noise(
    parameters: ParameterSet, block: Samples, size: ChannelValues
) -> Callable[[FloatArray], NDArray[np.complex128]]:
    """Return what the sensors' noise does to the residual K φ - y, at the middle of a block."""
    readings = Readings(parameters, block, size)
    to_motion, to_force = readings.slopes
    deviations = readings.noise
    # The residual's change by each channel of the motion and its two derivatives.
    changes = to_motion @ parameters.values

    def at(frequency: FloatArray) -> NDArray[np.complex128]:
        powers = (2j * np.pi * frequency) ** np.arange(3)[:, None]
        motion = np.einsum("kmn,kf->fnm", changes, powers)
        force = np.broadcast_to(-to_force, (len(frequency), *to_force.shape))
        return np.concatenate([motion, force], axis=2) * deviations

    return at


@dataclass(frozen=True)
class Readings:
    """The sensors of a block: encoders, gyroscope, accelerometer; then efforts and wrenches."""

    parameters: ParameterSet
    block: Samples
    size: ChannelValues

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """(J,) joints with a torque sensor."""
        return np.array([joint.effort > 0 for joint in self.parameters.model.joints])

    @property
    def noise(self) -> FloatArray:
        """Deviation of each channel (c,)."""
        size = self.size
        joints, feet = len(self.driven), len(self.block.wrench_frames)
        motion = [size.joint_position] * joints + [size.angular_velocity] * 3
        motion += [size.linear_acceleration] * 3 + [size.joint_effort] * int(self.driven.sum())
        return np.array(motion + feet * (3 * [size.moment] + 3 * [size.force]))

    @property
    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Changes of K (3, m, n, p) by the motion and its derivatives, and of y (n, k) by forces.

        At the middle of the block. Those of y by the motion, through the contacts' lever arms, are
        left out: what the encoders' noise does through them is a hundredth of the forces' noise.
        """
        joints, imu = len(self.driven), ideal_imu(self.parameters, self.block)
        middle = slice(len(self.block) // 2, len(self.block) // 2 + 1)
        parts = [self.block.position, self.block.velocity, self.block.acceleration]
        parts += [imu.angular_velocity, imu.angular_acceleration, imu.specific_force]
        values = np.hstack([part[middle] for part in parts])[0]
        count = len(values)
        shifts = STEP * np.eye(count)
        K = self._regressor(np.vstack([values + shifts, values - shifts]))
        K = (K[:count] - K[count:]) / (2 * STEP)
        slopes = np.zeros((3, joints + 6, *K.shape[1:]))
        slopes[:, :joints] = K[: 3 * joints].reshape(3, joints, *K.shape[1:])
        slopes[0, joints : joints + 3], slopes[1, joints : joints + 3] = K[-9:-6], K[-6:-3]
        slopes[0, joints + 3 :] = K[-3:]
        place = slice(-joints, None)
        effort = np.eye(K.shape[1])[:, place][:, self.driven]
        poses = link_poses(self.parameters.model, self.block.position[middle])
        jacobian = contact_jacobian(self.parameters.model, self.block.wrench_frames, poses)[0]
        return slopes, np.hstack([effort, jacobian.reshape(-1, K.shape[1]).T])

    def _regressor(self, values: FloatArray) -> FloatArray:
        """Return K (N, n, p) for N vectors of motion, as the IMU and the encoders tell it."""
        joints = len(self.driven)
        q, rate, acceleration, gyro, alpha, force = np.split(
            values, np.cumsum([joints, joints, joints, 3, 3]), axis=1
        )
        readings = BaseMotion(gyro, alpha, force)
        base = base_motion(self.parameters.model, IMU, (q, rate, acceleration), readings)
        empty = np.zeros((len(values), *self.block.wrenches.shape[1:]))
        samples = replace(
            self.block[:1],
            stamp=np.zeros(len(values), np.int64),
            position=q,
            velocity=rate,
            acceleration=acceleration,
            effort=np.zeros_like(q),
            base_angular_velocity=base.angular_velocity,
            base_angular_acceleration=base.angular_acceleration,
            base_specific_force=base.specific_force,
            wrenches=empty,
        )
        return equation_of_motion(self.parameters, samples).K


def expected_errors(
    parameters: ParameterSet, covariance: FloatArray, motion: TrueMotion
) -> tuple[float, float]:
    """Return the RMS errors of CoM, mm, and torque, Nm, that a covariance (p, p) implies."""
    samples = motion.samples
    L = np.linalg.cholesky(covariance)
    squares = [np.mean(np.sum((com_slope(parameters, samples) @ L) ** 2, axis=(1, 2)))]
    K = equation_of_motion(parameters, samples).K[:, -samples.position.shape[1] :]
    squares.append(np.mean(np.sum((K @ L) ** 2, axis=(1, 2))))
    com_error, torque = np.sqrt(squares)
    return 1e3 * float(com_error), float(torque)


def com_slope(parameters: ParameterSet, samples: Samples) -> FloatArray:
    """Return the change of the CoM (N, 3, p), m, with the true robot's parameters."""
    truth = parameters.values
    poses = link_poses(parameters.model, samples.position)
    masses = np.zeros(len(truth))
    masses[: parameters.inertial : 10] = 1.0
    com = com_position(parameters, truth, poses)
    slope: FloatArray = first_moment_regressor(parameters, poses) - com[:, :, None] * masses
    return slope / (masses @ truth)
