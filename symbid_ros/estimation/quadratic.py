"""A least-squares problem about its free minimum, in units that suit any solver."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr, solve_triangular

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError


@dataclass(frozen=True)
class Quadratic:
    """‖factor φ - target‖² as ‖R (x - x₀)‖² + c, with x = φ / scale.

    Attributes
    ----------
    scale : (p,) float64
        The parameters' units.
    triangle : (p, p) float64
        R, upper triangular.
    minimum : (p,) float64
        x₀.
    """

    scale: FloatArray
    triangle: FloatArray
    minimum: FloatArray

    @classmethod
    def of(cls, factor: FloatArray, target: FloatArray, scale: FloatArray) -> "Quadratic":
        """Return ‖factor φ - target‖² (r rows) in units of ``scale`` (p,).

        Raises
        ------
        EstimateError
            When a number is not finite, or the rows do not determine φ.
        """
        if not (np.all(np.isfinite(factor)) and np.all(np.isfinite(target))):
            raise EstimateError(
                "a row of data or prior is not finite; mask the sample it came from"
            )
        if not np.all((scale > 0) & np.isfinite(scale)):
            raise EstimateError(
                "a prior standard deviation is not a positive number; mend the prior"
            )
        count = len(scale)
        rows = np.column_stack([factor * scale, target])
        triangle = np.asarray(qr(rows, mode="r", overwrite_a=True)[0], dtype=np.float64)
        R, projected = triangle[:count, :count], triangle[:count, count]
        pivots = np.abs(np.diag(R))
        if len(R) < count or pivots.min() <= count * np.finfo(float).eps * pivots.max():
            raise EstimateError(
                "data and prior together do not determine all parameters; give each a prior "
                "standard deviation in proportion to the others"
            )
        return cls(scale, R, np.asarray(solve_triangular(R, projected)))

    def in_deviations(self, matrix: FloatArray) -> FloatArray:
        """Return matrix R⁻¹ (m, p): rows on x as rows on u, in posterior deviations."""
        return np.asarray(solve_triangular(self.triangle, matrix.T, trans="T").T)

    def point(self, u: FloatArray) -> FloatArray:
        """Return x (p,) at u (p,) posterior deviations from the minimum."""
        return np.asarray(self.minimum + solve_triangular(self.triangle, u))

    def deviations(self, x: FloatArray) -> FloatArray:
        """Return u (p,), the posterior deviations of x (p,) from the minimum."""
        return np.asarray(self.triangle @ (x - self.minimum))
