"""Expected information of a motion, the torques that it needs, and the gradients of both.

With φ = φ̄ + L x, x ~ N(0, 1) before the motion, rows K_t at samples t with noise of precision W
give the posterior precision H = 1 + Lᵀ (Σ K_tᵀ W K_t) L. Its log determinant is twice the mutual
information of log and parameters: a Bayesian D-optimal design (Chaloner and Verdinelli 1995,
Statistical Science 10(3)).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.friction import by_kind
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import without_contacts
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

# Coulomb friction changes its sign over this speed, rad/s, m/s of prismatic joints: smooth for the
# optimiser. Slower rows are discarded in an identification, as the joint may stick.
SMOOTH_SPEED = 0.1, 0.01
ROUNDING = 1e-14
STEP = 1e-4  # rad or m, and per second, of central differences; their error is below 1e-7
ACCELERATION_STEP = 1e-2  # rad/s² or m/s², of forward differences; K is linear in it


class MotionSpace(Protocol):
    """Coordinates that a trajectory moves, and the motion of the robot that follows.

    :class:`symbid_ros.excitation.fourier.DrivenJoints` moves the joints of a robot on a fixed base,
    :class:`symbid_ros.excitation.standing_motion.StandingMotion` the base of a standing one.
    """

    @property
    def model(self) -> RobotModel:
        """The robot, without unmeasured contacts."""
        ...

    @property
    def indices(self) -> tuple[int, ...]:
        """The joints that move."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        ...

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the D coordinates."""
        ...

    @property
    def rest(self) -> FloatArray:
        """(D,) coordinates of a robot at rest."""
        ...

    def samples(self, motion: FloatArray) -> Samples:
        """Return the robot's motion for coordinates, rates and accelerations (3, N, D)."""
        ...

    def limited(self, motion: FloatArray) -> tuple[Samples, Callable[[FloatArray], FloatArray]]:
        """Return the motion, and the shares of limits (N, k) as a function of forces (N, n).

        A motion is feasible if no share is larger than 1 in magnitude.
        """
        ...

    def share_names(self, count: int) -> list[str]:
        """Return the names of the ``count`` shares of `limited`."""
        ...

    def torques(self, motion: FloatArray, force: FloatArray) -> FloatArray:
        """Return the efforts of the joints that move for generalised forces (N, n)."""
        ...

    def slopes(self, motion: FloatArray) -> FloatArray:
        """Return the derivatives (N, J, D) of all joints' positions by the coordinates."""
        ...


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
    precision : (n, n) float64
        Inverse covariance of the noise of one instant's rows; zero for rows that are not used.
    joints : MotionSpace
    """

    parameters: ParameterSet
    values: FloatArray
    factor: FloatArray
    precision: FloatArray
    joints: MotionSpace

    @cached_property
    def _links(self) -> ParameterSet:
        return ParameterSet(self.joints.model)

    @cached_property
    def _root(self) -> FloatArray:
        """(n, n) U of the precision Uᵀ U."""
        size, axes = np.linalg.eigh(self.precision)
        return np.asarray(np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T)

    def rows(self, motion: FloatArray) -> FloatArray:
        """Return the regressor K (N, n, p) of a motion (3, N, D), with smooth Coulomb friction.

        Unmeasured contact forces are part of K φ.
        """
        return self._rows(self.joints.samples(motion))

    def shares(self, motion: FloatArray) -> FloatArray:
        """Return the shares of limits (N, k) of a motion (3, N, D), at most 1 in magnitude."""
        return self._measured(motion)[1]

    def measured_rows(self, motion: FloatArray) -> FloatArray:
        """Return the regressor K (N, n, p) of a motion without unmeasured contact forces."""
        return self._measured(motion)[0]

    def _measured(self, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
        samples, shares = self.joints.limited(motion)
        K = self._rows(samples)
        used = shares(K @ self.values)
        if self.parameters.model.contacts is not None:
            K = without_contacts(self.parameters.model, samples, K)
        return K, used

    def _rows(self, samples: Samples) -> FloatArray:
        K = np.zeros((len(samples), self.joints.model.dof, len(self.parameters)))
        inertial = self.parameters.inertial
        K[..., :inertial] = equation_of_motion(self._links, samples).K[..., :inertial]
        own, first = self.parameters.joints, 6 * self.joints.model.floating
        factors = {
            "viscous": samples.velocity,
            "coulomb": np.tanh(samples.velocity / by_kind(SMOOTH_SPEED, self.joints.model.joints)),
            "armature": samples.acceleration,
            "offset": np.ones_like(samples.velocity),
        }
        for term, columns in self.parameters.term_columns.items():
            K[:, first + own, range(columns.start, columns.stop)] = factors[term][:, own]
        terms = K[..., inertial:].copy()
        self.joints.model.fold_followers(terms)
        K[..., inertial:] = terms
        return K

    def whitened(self, K: FloatArray) -> FloatArray:
        """Return rows (N, n, p) with noise of unit variance, stacked, (N n, p)."""
        return np.asarray((self._root @ K).reshape(-1, K.shape[2]))

    def information(self, K: FloatArray) -> FloatArray:
        """Return the information Σ Kᵀ W K (p, p) of rows (N, n, p)."""
        rows = self.whitened(K)
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
        """Return gain and limits of a motion (3, N, D) whose rows count ``repeats`` times.

        Sensitivities are derivatives with respect to position, velocity and acceleration of each
        coordinate at each sample. K is linear in acceleration and quadratic in velocity, so
        that differences are exact except for rounding and for smooth functions of position.
        """
        K, shares = self._measured(motion)
        H = self.posterior_precision(repeats * self.information(K))
        try:
            decomposition = cho_factor(H)
        except np.linalg.LinAlgError:  # rounding, in motions far beyond the limits
            decomposition = cho_factor(H + ROUNDING * np.trace(H) * np.eye(len(H)))
        gain = float(np.sum(np.log(np.diag(decomposition[0]))))
        covariance = self.factor @ cho_solve(decomposition, self.factor.T)
        weight = repeats * self.precision @ (K @ covariance)
        moved = motion.shape[2]
        gains = np.empty((3, len(K), moved))
        slopes = np.empty((3, *shares.shape, moved))
        for place in range(moved):
            for order, (change, use) in enumerate(self._differences(motion, place, (K, shares))):
                gains[order, :, place] = np.einsum("tnp,tnp->t", weight, change)
                slopes[order, :, :, place] = use
        return Evaluation(gain, shares, gains, slopes)

    def _differences(
        self, motion: FloatArray, place: int, here: tuple[FloatArray, FloatArray]
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield derivatives of K and shares by position, velocity, acceleration of a coordinate."""
        for order in range(2):
            ahead, behind = motion.copy(), motion.copy()
            ahead[order, :, place] += STEP
            behind[order, :, place] -= STEP
            both = zip(self._measured(ahead), self._measured(behind), strict=True)
            K, shares = ((after - before) / (2 * STEP) for after, before in both)
            yield K, shares
        ahead = motion.copy()
        ahead[2, :, place] += ACCELERATION_STEP
        both = zip(self._measured(ahead), here, strict=True)
        K, shares = ((after - before) / ACCELERATION_STEP for after, before in both)
        yield K, shares


@dataclass(frozen=True)
class Evaluation:
    """Gain of information and use of limits of a motion, with their sensitivities.

    Attributes
    ----------
    gain : float
        Nat.
    shares : (N, k) float64
        Of the limits, for the expected parameters; at most 1 in magnitude is allowed.
    gain_slopes : (3, N, D) float64
        Derivatives of the gain by position, velocity, acceleration of each sample and coordinate.
    share_slopes : (3, N, k, D) float64
        Derivatives of each sample's shares by its own motion.
    """

    gain: float
    shares: FloatArray
    gain_slopes: FloatArray
    share_slopes: FloatArray
