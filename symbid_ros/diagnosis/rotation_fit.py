"""Fits a sign, scale and rotation to a sensor's gain matrix."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray

STARTS = 4  # number of the cube's 24 rotations that are refined, the best first
# A fit within this many squared deviations of the best is equally good.
ALIKE = 9.0


@dataclass(frozen=True)
class RotationFit:
    """A ≈ scale · sign · rotation.

    Attributes
    ----------
    sign : int
        1 or -1.
    rotation : (3, 3) float64
        From the axes in which the sensor reports to those of its frame in the model.
    angle : float
        Angle of the rotation, rad.
    scale : float
        Factor that maps readings to true values.
    cost : float
        Squared distance to A in standard deviations.
    plain : float
        Cost without sign change and rotation.
    """

    sign: int
    rotation: FloatArray
    angle: float
    scale: float
    cost: float
    plain: float


def fit_rotation(
    matrix: FloatArray, covariance: FloatArray, *, is_scaled: bool = True
) -> RotationFit:
    """Return the rotation and sign closest to A (3, 3) given the covariance (9, 9) of its rows.

    The scale is fitted too if ``is_scaled``, else it is one.
    """
    weight = np.linalg.inv(np.linalg.cholesky(covariance))
    target = weight @ matrix.ravel()

    def scaled(unit: FloatArray) -> tuple[float, float]:
        """Return the best positive scale of a matrix and its cost."""
        row = weight @ unit.ravel()
        scale = max(float(row @ target) / float(row @ row), 1e-3) if is_scaled else 1.0
        return scale, float(np.sum((scale * row - target) ** 2))

    plain_scale, plain = scaled(np.eye(3))
    found = [RotationFit(1, np.eye(3), 0.0, plain_scale, plain, plain)]
    if plain < ALIKE:
        return found[0]
    from scipy.optimize import least_squares  # noqa: PLC0415 - loads slowly, and is seldom needed

    scale, cost = scaled(-np.eye(3))
    found.append(RotationFit(-1, np.eye(3), 0.0, scale, cost, plain))
    for sign in (1, -1):
        starts = sorted(_cube_rotations(), key=lambda turn: scaled(sign * turn)[1])[:STARTS]
        for start in starts:
            guess = np.append(np.zeros(3), np.log(scaled(sign * start)[0]))[: 3 + is_scaled]

            def residual(x: FloatArray, start: FloatArray = start, sign: int = sign) -> FloatArray:
                size = np.exp(x[3]) if is_scaled else 1.0
                unit = sign * size * Rotation.from_rotvec(x[:3]).as_matrix() @ start
                left: FloatArray = weight @ unit.ravel() - target
                return left

            fit = least_squares(residual, guess, method="lm")
            turn = Rotation.from_rotvec(fit.x[:3]).as_matrix() @ start
            size = float(np.exp(fit.x[3])) if is_scaled else 1.0
            angle = float(Rotation.from_matrix(turn).magnitude())
            found.append(RotationFit(sign, turn, angle, size, 2 * float(fit.cost), plain))
    # Of equally good fits the simplest is taken, so no rotation is reported without evidence.
    best = min(one.cost for one in found)
    equally_good = [one for one in found if one.cost < best + ALIKE]
    return min(equally_good, key=lambda one: (one.angle > 1e-6, one.sign < 0, one.cost))


def _cube_rotations() -> list[FloatArray]:
    """Return the 24 rotations that map axes to axes."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found
