"""How much a log can tell if its motion is unknown too: a bound on every estimator.

Usage: .venv/bin/python bench/motion_bound.py [--seed 300] [--draws 6] [--cases smooth vibrating]

All sensors of the Symbitron are noisy at 1 kHz, and nothing is filtered. The motion is measured by
encoders and IMU alone, so their noise, differentiated as often as the equation of motion asks for,
hides fast motion: that of an encoder grows with the square of the frequency. Prints the Bayesian
Cramér-Rao bound with the information in each band of frequencies, and the errors of `map_lmi` on
the same logs, as roots of means of squares over draws.

That the soles stay at rest is not used, neither here nor by `symbid identify`.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from estimators import MODEL, STRIDE, identified
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import (
    com_position,
    equation_of_motion,
    first_moment_regressor,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.evaluation import TrueMotion, evaluate
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.settings import load_noise
from symbid_ros.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]
RATE = 1000.0  # Hz
BLOCK = 1024  # samples in which the posture counts as constant
EDGES = (0.0, 2.0, 10.0, 30.0, 100.0, 500.1)  # Hz
IMU = "imu_link"
STEP = 1e-5
PERCENT = 25.0


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seed", type=int, default=300)
    options.add_argument("--draws", type=int, default=6)
    options.add_argument("--moves", type=int, default=20)
    options.add_argument("--method", default="map_lmi")
    options.add_argument("--cases", nargs="+", default=["smooth", "vibrating"])
    given = options.parse_args()
    parameters = ParameterSet(load_model(MODEL))
    bands = [f"{low:g}–{high:.0f} Hz" for low, high in pairwise(EDGES)]
    columns = "log", "joint accelerations, rad/s²", "CoM, mm: bound", "error", "torque, Nm: bound"
    columns = *columns, "error", *(f"bits, {band}" for band in bands)
    print(f"| {' | '.join(columns)} |\n{len(columns) * '|---'}|", flush=True)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        for case in given.cases:
            print(row(case, given, parameters, Path(folder)), flush=True)


def row(case: str, given: argparse.Namespace, parameters: ParameterSet, folder: Path) -> str:
    """Return the figures of one kind of motion: roots of means of squares over the draws."""
    judged = simulated(folder / f"judged_{case}", "smooth", given.seed + 5000, 10)[::STRIDE]
    truth, figures = parameters.values, []
    for seed in range(given.seed, given.seed + given.draws):
        motion = simulated(folder / f"ideal_{case}_{seed}", case, seed, given.moves)
        prior = draw_prior(parameters, "percent", PERCENT, seed)
        scale = prior.covariance_factor()
        bits, total = [], np.eye(len(truth))
        for part in band_information(parameters, motion.samples):
            before = np.linalg.slogdet(total)[1]
            total = total + scale.T @ part @ scale
            bits.append(0.5 * (np.linalg.slogdet(total)[1] - before) / np.log(2))
        bound = scale @ np.linalg.inv(total) @ scale.T
        log = folder / f"{case}_{seed}"
        noisy = SimulateOptions(case, moves=given.moves, motion_seed=seed, noise_seed=seed)
        record(Simulator(noisy), log)
        ((found, _),) = identified(log, None, parameters, [prior], given)
        errors = evaluate(parameters, {"": found.estimate.value}, truth, judged)[""]
        com, torque = expected_errors(parameters, bound, judged)
        speed_up = np.sqrt(np.mean(motion.samples.acceleration**2))
        figures.append(
            [speed_up, com, errors.com_position_rmse_mm, torque, errors.torque_rmse, *bits]
        )
    means = np.sqrt(np.mean(np.square(figures), axis=0))
    cells = [f"{value:.3g}" for value in means[:5]] + [f"{value:.1f}" for value in means[5:]]
    return f"| {case} | {' | '.join(cells)} |"


def simulated(bag: Path, scenario: str, seed: int, moves: int) -> TrueMotion:
    """Return the true motion of a simulation."""
    record(Simulator(SimulateOptions(scenario, moves=moves, motion_seed=seed, ideal=True)), bag)
    return read_true_motion([bag], load_model(MODEL))


def band_information(parameters: ParameterSet, motion: Samples) -> FloatArray:
    """Return the information (B, p, p) about the parameters in each band of frequencies."""
    total = np.zeros((len(EDGES) - 1, len(parameters), len(parameters)))
    for start in range(0, len(motion) - BLOCK + 1, BLOCK // 2):
        block = motion[start : start + BLOCK]
        K = equation_of_motion(parameters, block).K
        total += information(K, RATE, sensor_noise(parameters, block), EDGES)
    return total


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
    parameters: ParameterSet, block: Samples
) -> Callable[[FloatArray], NDArray[np.complex128]]:
    """Return what the sensors' noise does to the residual K φ - y, at the middle of a block."""
    readings = Readings(parameters, block)
    to_motion, to_force = readings.slopes
    size = readings.noise

    def at(frequency: FloatArray) -> NDArray[np.complex128]:
        motion = np.einsum("mnpf,p->fnm", in_time(to_motion, frequency), parameters.values)
        force = np.broadcast_to(-to_force, (len(frequency), *to_force.shape))
        return np.concatenate([motion, force], axis=2) * size

    return at


def in_time(slopes: FloatArray, frequency: FloatArray) -> NDArray[np.complex128]:
    """Return the change of K (m, n, p, F) by each channel of the motion.

    ``slopes`` (3, m, n, p) are those by a channel and its two derivatives.
    """
    powers = (2j * np.pi * frequency) ** np.arange(3)[:, None]
    return np.einsum("kmnp,kf->mnpf", slopes, powers)


@dataclass(frozen=True)
class Readings:
    """The sensors of a block: encoders, gyroscope, accelerometer; then efforts and wrenches."""

    parameters: ParameterSet
    block: Samples

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """(J,) joints with a torque sensor."""
        return np.array([joint.effort > 0 for joint in self.parameters.model.joints])

    @property
    def noise(self) -> FloatArray:
        """Deviation of each channel (c,)."""
        size = load_noise(config_file("noise.yaml"))
        joints, feet = len(self.driven), len(self.block.wrench_frames)
        motion = [size.joint_position] * joints + [size.angular_velocity] * 3
        motion += [size.linear_acceleration] * 3 + [size.joint_effort] * int(self.driven.sum())
        return np.array(motion + feet * (3 * [size.moment] + 3 * [size.force]))

    @property
    def imu(self) -> BaseMotion:
        """What an ideal IMU reads, with its angular acceleration."""
        frame, block = self.parameters.model.frame(IMU), self.block
        omega, alpha = block.base_angular_velocity, block.base_angular_acceleration
        force = block.base_specific_force + np.cross(alpha, frame.translation)
        force = force + np.cross(omega, np.cross(omega, frame.translation))
        return BaseMotion(*(one @ frame.rotation for one in (omega, alpha, force)))

    @property
    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Changes of K (3, m, n, p) by the motion and its derivatives, and of y (n, k) by forces.

        At the middle of the block. Those of y by the motion, through the contacts' lever arms, are
        left out: what the encoders' noise does through them is a hundredth of the forces' noise.
        """
        joints, imu = len(self.driven), self.imu
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
    truth, samples = parameters.values, motion.samples
    poses = link_poses(parameters.model, samples.position)
    masses = np.zeros(len(truth))
    masses[: parameters.inertial : 10] = 1.0
    com = com_position(parameters, truth, poses)
    slope = first_moment_regressor(parameters, poses) - com[:, :, None] * masses
    slope /= masses @ truth
    L = np.linalg.cholesky(covariance)
    squares = [np.mean(np.sum((slope @ L) ** 2, axis=(1, 2)))]
    K = equation_of_motion(parameters, samples).K[:, -samples.position.shape[1] :]
    squares.append(np.mean(np.sum((K @ L) ** 2, axis=(1, 2))))
    com_error, torque = np.sqrt(squares)
    return 1e3 * float(com_error), float(torque)


if __name__ == "__main__":
    main()
