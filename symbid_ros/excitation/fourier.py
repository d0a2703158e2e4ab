"""Periodic motions: finite Fourier series for each joint, at rest where a period begins.

A finite series is smooth, its derivatives are exact, and repeated periods can be averaged (Swevers,
Ganseman, Tükel, De Schutter and Van Brussel 1997, Optimal robot excitation and identification, IEEE
Trans. Robotics and Automation 13(5)).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class FourierSeries:
    """The functions of time that the motion of each joint is a sum of.

    The functions are a constant and combinations of K sines and cosines whose velocity and
    acceleration are zero at the start of each period. The motion can thus start and stop there.

    Attributes
    ----------
    period : float
        Seconds.
    harmonics : int
        K, at least 2.
    """

    period: float
    harmonics: int

    @property
    def size(self) -> int:
        """Number m of functions: coefficients of each joint."""
        return 2 * self.harmonics - 1

    @cached_property
    def _combinations(self) -> FloatArray:
        """(2 K, m - 1) amplitudes of sines, then cosines, that start at rest."""
        order = np.arange(1, self.harmonics + 1)
        # Velocity at the start: Σ k a_k = 0; acceleration: Σ k² b_k = 0.
        sines, cosines = null_space(order[None]), null_space(order[None] ** 2)
        zeros = np.zeros_like(sines)
        return np.block([[sines, zeros], [zeros, cosines]])

    def basis(self, time: FloatArray) -> FloatArray:
        """Return value, velocity and acceleration (3, N, m) of each function at times (N,), s."""
        order = 2 * np.pi / self.period * np.arange(1, self.harmonics + 1)
        angle = time[:, None] * order
        sine, cosine = np.sin(angle), np.cos(angle)
        waves = np.stack(
            [
                np.hstack([sine, cosine]),
                np.hstack([order * cosine, -order * sine]),
                np.hstack([-(order**2) * sine, -(order**2) * cosine]),
            ]
        )
        constant = np.zeros((3, len(time), 1))
        constant[0] = 1.0
        return np.concatenate([constant, waves @ self._combinations], axis=2)

    def motion(self, coefficients: FloatArray, time: FloatArray) -> FloatArray:
        """Return position, velocity and acceleration (3, N, D) for coefficients (m, D)."""
        motion: FloatArray = self.basis(time) @ coefficients
        return motion


@dataclass(frozen=True)
class DrivenJoints:
    """The joints that a trajectory moves, and the motion of all joints that follows.

    Attributes
    ----------
    model : RobotModel
        With a fixed base.
    indices : (D,) int64
        The joints that move.
    posture : (J,) float64
        Position of the joints that do not move.
    effort : (D,) float64
        Largest effort that a trajectory may use, Nm or N; infinite for none.
    """

    model: RobotModel
    indices: tuple[int, ...]
    posture: FloatArray
    effort: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(self.model.joint_names[index] for index in self.indices)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the functions of time: each joint has its own."""
        return self.names

    @property
    def rest(self) -> FloatArray:
        """(D,) coordinates of a robot at rest."""
        return self.posture[list(self.indices)]

    def torques(self, motion: FloatArray, force: FloatArray) -> FloatArray:
        """Return the efforts (N, D) of the joints for generalised forces (N, n)."""
        return np.asarray(force[:, list(self.indices)])

    def limited(self, motion: FloatArray) -> tuple[Samples, Callable[[FloatArray], FloatArray]]:
        """Return the motion, and the shares of efforts (N, D) as a function of forces (N, n)."""
        return self.samples(motion), lambda force: self.torques(motion, force) / self.effort

    def share_names(self, count: int) -> list[str]:
        """Return the names of the ``count`` shares of `limited`."""
        return [f"the effort of {name}" for name in self.names[:count]]

    def slopes(self, motion: FloatArray) -> FloatArray:
        """Return the derivatives (N, J, D) of all joints' positions by the coordinates."""
        chosen = np.zeros((len(self.model.joints), len(self.indices)))
        chosen[list(self.indices), range(len(self.indices))] = 1.0
        return np.broadcast_to(chosen, (motion.shape[1], *chosen.shape))

    def samples(self, motion: FloatArray) -> Samples:
        """Return the motion of the robot for position, velocity and acceleration (3, N, D)."""
        count = motion.shape[1]
        complete = np.zeros((3, count, len(self.model.joints)))
        complete[0] = self.posture
        complete[:, :, self.indices] = motion
        rest = np.zeros((count, 3))
        return Samples(
            stamp=np.arange(count, dtype=np.int64),
            position=self.model.apply_mimics(complete[0]),
            velocity=self.model.apply_mimics(complete[1], rates=True),
            acceleration=self.model.apply_mimics(complete[2], rates=True),
            effort=np.zeros(complete[0].shape),
            base_angular_velocity=rest,
            base_angular_acceleration=rest,
            base_specific_force=rest - self.model.gravity,
            wrenches=np.zeros((count, 0, 6)),
            wrench_frames=(),
        )
