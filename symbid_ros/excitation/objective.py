"""Expected information of a motion, the torques that it needs, and the gradients of both.

With φ = φ̄ + L x, x ~ N(0, 1) before the motion, rows K_t at samples t with noise of precision W
give the posterior precision H = 1 + Lᵀ (Σ K_tᵀ W K_t) L. Its log determinant is twice the mutual
information of log and parameters: a Bayesian D-optimal design (Chaloner and Verdinelli 1995,
Statistical Science 10(3)).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.excitation.fourier import DrivenJoints
from symbid_ros.model.parameters import ParameterSet

# Coulomb friction changes its sign over this speed, rad/s or m/s: smooth for the optimiser. Slower
# rows are discarded in an identification, as the joint may stick.
SMOOTH_SPEED = 0.1
ROUNDING = 1e-14
STEP = 1e-4  # rad or m, and per second, of central differences; their error is below 1e-7


@dataclass(frozen=True)
class ExpectedInformation:
    """What rows of the equation of motion will tell about parameters.

    Attributes
    ----------
    parameters : ParameterSet
        The p columns.
    values : (p,) float64
        Expected values, which give the torques.
    factor : (p, r) float64
        L of the covariance L Lᵀ before the motion.
    precision : (n,) float64
        Inverse variance of one row of each coordinate, for rows with independent noise.
    joints : DrivenJoints
    """

    parameters: ParameterSet
    values: FloatArray
    factor: FloatArray
    precision: FloatArray
    joints: DrivenJoints

    @cached_property
    def _links(self) -> ParameterSet:
        return ParameterSet(self.joints.model)

    def rows(self, motion: FloatArray) -> FloatArray:
        """Return the regressor K (N, n, p) of a motion (3, N, D), with smooth Coulomb friction."""
        return self._rows(self.joints.samples(motion))

    def _rows(self, samples: Samples) -> FloatArray:
        K = np.zeros((len(samples), self.joints.model.dof, len(self.parameters)))
        inertial = self.parameters.inertial
        K[..., :inertial] = equation_of_motion(self._links, samples).K[..., :inertial]
        own = self.parameters.joints
        factors = {
            "viscous": samples.velocity,
            "coulomb": np.tanh(samples.velocity / SMOOTH_SPEED),
            "armature": samples.acceleration,
            "offset": np.ones_like(samples.velocity),
        }
        for term, columns in self.parameters.term_columns.items():
            K[:, own, range(columns.start, columns.stop)] = factors[term][:, own]
        terms = K[..., inertial:].copy()
        self.joints.model.fold_followers(terms)
        K[..., inertial:] = terms
        return K

    def information(self, K: FloatArray) -> FloatArray:
        """Return the information Σ Kᵀ W K (p, p) of rows (N, n, p)."""
        rows = (np.sqrt(self.precision)[:, None] * K).reshape(-1, K.shape[2])
        moment: FloatArray = rows.T @ rows
        return moment

    def posterior_precision(self, information: FloatArray) -> FloatArray:
        """Return H (r, r) in units of the deviations before the motion."""
        H: FloatArray = np.eye(self.factor.shape[1]) + self.factor.T @ information @ self.factor
        return H

    def gain(self, information: FloatArray) -> float:
        """Return the expected gain of information, nat: half the log determinant of H."""
        sign, logarithm = np.linalg.slogdet(self.posterior_precision(information))
        return 0.5 * float(logarithm) if sign > 0 else -np.inf

    def posterior_factor(self, information: FloatArray) -> FloatArray:
        """Return L (p, r) of the covariance after the motion."""
        H = self.posterior_precision(information)
        root = np.linalg.cholesky(H)
        factor: FloatArray = np.linalg.solve(root, self.factor.T).T
        return factor

    def evaluate(self, motion: FloatArray, repeats: float) -> "Evaluation":
        """Return gain and torques of a motion (3, N, D) whose rows count ``repeats`` times.

        Sensitivities are derivatives with respect to position, velocity and acceleration of each
        moving joint at each sample. K is linear in acceleration and quadratic in velocity, so
        that differences are exact except for rounding and for smooth functions of position.
        """
        K = self.rows(motion)
        H = self.posterior_precision(repeats * self.information(K))
        try:
            decomposition = cho_factor(H)
        except np.linalg.LinAlgError:  # rounding, in motions far beyond the limits
            decomposition = cho_factor(H + ROUNDING * np.trace(H) * np.eye(len(H)))
        gain = float(np.sum(np.log(np.diag(decomposition[0]))))
        covariance = self.factor @ cho_solve(decomposition, self.factor.T)
        weight = repeats * self.precision[:, None] * (K @ covariance)
        torque = K @ self.values
        moved = motion.shape[2]
        gains = np.empty((3, len(K), moved))
        torques = np.empty((3, *torque.shape, moved))
        for joint in range(moved):
            for order, change in enumerate(self._differences(motion, joint, K)):
                gains[order, :, joint] = np.einsum("tnp,tnp->t", weight, change)
                torques[order, :, :, joint] = change @ self.values
        return Evaluation(gain, torque, gains, torques)

    def _differences(self, motion: FloatArray, joint: int, K: FloatArray) -> Iterator[FloatArray]:
        """Yield the derivative of K by position, velocity and acceleration of one joint."""
        for order in range(2):
            ahead, behind = motion.copy(), motion.copy()
            ahead[order, :, joint] += STEP
            behind[order, :, joint] -= STEP
            yield (self.rows(ahead) - self.rows(behind)) / (2 * STEP)
        ahead = motion.copy()
        ahead[2, :, joint] += 1.0
        yield self.rows(ahead) - K


@dataclass(frozen=True)
class Evaluation:
    """Gain of information and torques of a motion, with their sensitivities.

    Attributes
    ----------
    gain : float
        Nat.
    torque : (N, n) float64
        Nm or N, of the expected parameters.
    gain_slopes : (3, N, D) float64
        Derivatives of the gain by position, velocity, acceleration of each sample and joint.
    torque_slopes : (3, N, n, D) float64
        Derivatives of each sample's torques by its own motion.
    """

    gain: float
    torque: FloatArray
    gain_slopes: FloatArray
    torque_slopes: FloatArray
