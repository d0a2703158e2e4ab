"""All that the data say about the parameters, in one triangular factor.

Rows are folded by QR as they come and never stored. From the factor of the
*flat* sample row follow, with no second pass over the data, the least-squares
problem under any covariance of the residuals across coordinates, any column
scaling, prior or truncation, and the residual of any parameter vector.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack, qr
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import DataError
from symbid_ros.estimation.layout import RowLayout

DIFFERENT = "two records of different robots or columns cannot be merged"


@dataclass(frozen=True)
class Information:
    """The triangular factor of all flat rows so far.

    Attributes
    ----------
    layout : RowLayout
        What the flat row holds.
    factor : (w, w) float64
        Upper triangular R with RᵀR = Σ rowᵀ row.
    samples : float
        Number of samples folded in; where old ones fade, what is left of it.
    """

    layout: RowLayout
    factor: FloatArray
    samples: float

    @classmethod
    def empty(cls, layout: RowLayout) -> "Information":
        """Return the state before any data."""
        return cls(layout, np.zeros((layout.width, layout.width), order="F"), 0)

    def fold(self, blocks: Iterable[Rows]) -> "Information":
        """Return the information with more rows in it.

        Raises
        ------
        DataError
            When a row is not finite: one NaN would poison everything known so far.
        """
        factor, samples = self.factor.copy(order="F"), self.samples
        for rows in blocks:
            flat = self.layout.flatten(rows)
            if not np.all(np.isfinite(flat)):
                raise DataError("a sample of the equation of motion is not finite; mask it first")
            factor = _updated(factor, flat)
            samples += len(flat)
        return Information(self.layout, factor, samples)

    def faded(self, share: float) -> "Information":
        """Return the information with every row's weight times ``share``, from 0 to 1."""
        if self.samples == 0:
            return self
        return Information(self.layout, np.sqrt(share) * self.factor, share * self.samples)

    def merge(self, other: "Information") -> "Information":
        """Return the information of both records together.

        Raises
        ------
        DataError
            When the two are about different robots.
        """
        if (self.layout.coordinates, self.layout.parameters) != (
            other.layout.coordinates,
            other.layout.parameters,
        ) or not np.array_equal(self.layout.structure, other.layout.structure):
            raise DataError(DIFFERENT)
        factor = _updated(self.factor.copy(order="F"), other.factor)
        return Information(self.layout, factor, self.samples + other.samples)

    def coordinate_factor(self, coordinate: int) -> FloatArray:
        """Return the triangular factor of [K_i y_i] of one coordinate, its non-zeros only."""
        return self._coordinate_factors[coordinate]

    def whitened(self, whitening: FloatArray) -> FloatArray:
        """Return the factor of the stacked problem with rows weighted across coordinates.

        Parameters
        ----------
        whitening : (n, n) float64
            G: each sample's rows become G [K y]. A diagonal G is Eq. 31's, the
            inverse Cholesky factor of a residual covariance whitens it fully.

        Returns
        -------
        (p + 1, p + 1) float64
            Upper triangular factor of all rows G [K y].
        """
        layout = self.layout
        p = len(layout.parameters)
        stacked = []
        for row in whitening:
            used = np.flatnonzero(row)
            weighted = np.zeros((p + 1, self._parts[used[-1]].shape[1] if len(used) else 0))
            for coordinate in used:
                part = row[coordinate] * self._parts[coordinate]
                # Below its last column a stretch of a triangle is zero; columns never repeat.
                weighted[layout.columns[coordinate], : part.shape[1]] += part[:-1]
                weighted[p, : part.shape[1]] += part[-1]
            stacked.append(_triangle(weighted.T))
        return _triangle(np.concatenate([np.zeros((p + 1, p + 1)), *stacked]))

    def whitened_moment(self, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) for a precision P (n, n) across coordinates.

        Half the digits of :meth:`whitened` and a hundredth of its time, for what is only
        estimated, or on the way to what is not.
        """
        width = len(self.layout.parameters) + 1
        moment: FloatArray = self._products @ precision.ravel()
        return moment.reshape(width, width)

    @cached_property
    def _parts(self) -> tuple[FloatArray, ...]:
        """Each coordinate's stretch of the factor, transposed, its rows without content left out.

        Few samples fill few rows of a wide factor.
        """
        size = np.abs(self.factor).max(axis=1, initial=0.0)
        filled = size > 1e-15 * size.max(initial=0.0)
        return tuple(
            np.ascontiguousarray(self.factor[: place.stop, place][filled[: place.stop]].T)
            for place in self.layout.slices
        )

    @cached_property
    def _coordinate_factors(self) -> tuple[FloatArray, ...]:
        # Below row `place.stop` these columns of a triangle are zero.
        return tuple(_triangle(self.factor[: place.stop, place]) for place in self.layout.slices)

    @cached_property
    def _products(self) -> csr_array:
        """((p+1)(p+1), n n) the moments of [K y], by pairs of coordinates."""
        layout = self.layout
        # Half of a symmetric product is enough to know it.
        half = blas.dsyrk(1.0, self.factor, trans=True)
        gram = half + np.triu(half, 1).T
        shape = (len(layout.parameters) + 1) ** 2, len(layout.coordinates) ** 2
        places = layout.moment_places, layout.coordinate_pairs
        return csr_array((gram.ravel(), places), shape=shape)

    @cached_property
    def target_squares(self) -> FloatArray:
        """Σ y² (n,) over all samples."""
        ends = [place.stop - 1 for place in self.layout.slices]
        return np.asarray(np.sum(self.factor[:, ends] ** 2, axis=0))

    def residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return Σ e eᵀ (n, n) over all samples, e = y - K φ, for φ (p,)."""
        residual = self.factor @ self.layout.residual_map(phi)
        moment: FloatArray = residual.T @ residual
        return moment

    def rough_residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return :meth:`residual_moment` with half its digits, in a fifth of its time."""
        n = len(self.layout.coordinates)
        residual = np.append(-phi, 1.0)
        squares = np.outer(residual, residual).ravel()
        moment: FloatArray = self._products.T @ squares
        return moment.reshape(n, n)

    def residual_rmse(self, phi: FloatArray) -> dict[str, float]:
        """Return the root mean square of y - K φ per coordinate."""
        squares = np.diag(self.residual_moment(phi)) / max(self.samples, 1)
        return dict(zip(self.layout.coordinates, np.sqrt(squares).tolist(), strict=True))


def _updated(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the triangle with rows folded in; LAPACK's tpqrt leaves its zeros alone."""
    width = len(factor)
    # LAPACK works in the block it is given; a record's own factor may be the rows.
    block = np.array(rows, order="F")
    updated, _, _, info = lapack.dtpqrt(
        0, min(32, width), factor, block, overwrite_a=True, overwrite_b=True
    )
    if info != 0:
        raise DataError(f"LAPACK dtpqrt refused argument {-info}")
    triangle: FloatArray = updated
    return triangle


def stacked_factor(*blocks: FloatArray) -> FloatArray:
    """Return the square upper triangular factor of matrices (·, w) on top of one another."""
    return _triangle(np.concatenate(blocks))


def _triangle(matrix: FloatArray) -> FloatArray:
    """Return the square upper triangular factor of a matrix, padded with zero rows."""
    width = matrix.shape[1]
    square = np.zeros((width, width))
    if len(matrix):  # older SciPy, as Ubuntu 24.04 has it, refuses a matrix without rows
        (upper,) = qr(matrix, mode="r", check_finite=False)
        square[: min(len(upper), width)] = upper[:width]
    return square
