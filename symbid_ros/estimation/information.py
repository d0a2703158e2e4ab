"""Information of the data about the parameters, in one triangular factor.

QR updates fold in rows as they arrive. As long as these are fewer than columns, they are kept as
they are: the factor of a humanoid has thousands of columns, and that of a short log would be
mostly zeros. The factor of *flat* sample rows is enough, without a second pass over the data, for:

- the least-squares problem with any covariance of the residuals across coordinates, any column
  scaling, prior or truncation,
- the residual of any parameter vector.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, qr
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import DataError
from symbid_ros.estimation.column_groups import ColumnGroups
from symbid_ros.estimation.qr_update import fold_rows
from symbid_ros.estimation.row_layout import RowLayout

# Width of flat rows from which moments of all pairs of columns take longer than those of the few
# weights that an identification tries, and hundreds of MB for each window length.
WIDE = 4000
# Rows that are folded at once: LAPACK takes half the time per row for many as for few.
ROWS_AT_ONCE = 512

INCOMPATIBLE = "information about different robots or parameters cannot be merged"


@dataclass(frozen=True)
class Information:
    """The triangular factor of all flat rows so far.

    Attributes
    ----------
    layout : RowLayout
        Layout of the flat rows.
    factor : (r, w) float64
        R with RᵀR = Σ rowᵀ row: upper triangular if r = w, otherwise fewer rows of any kind.
    samples : float
        Number of samples folded in; the effective number if old ones are discounted.
    """

    layout: RowLayout
    factor: FloatArray
    samples: float

    @classmethod
    def empty(cls, layout: RowLayout) -> "Information":
        """Return the information of no data."""
        return cls(layout, np.zeros((0, layout.width)), 0)

    def fold(self, blocks: Iterable[Rows]) -> "Information":
        """Return the information with more rows.

        Raises
        ------
        DataError
            When a row is not finite, because one NaN would destroy all information.
        """
        found: Information = self
        waiting: list[Rows] = []
        for rows in blocks:
            waiting.append(rows)
            if sum(len(each.y) for each in waiting) >= ROWS_AT_ONCE:
                found, waiting = found.fold_flat(self.layout.flatten(waiting)), []
        return found.fold_flat(self.layout.flatten(waiting)) if waiting else found

    def fold_flat(self, flat: FloatArray) -> "Information":
        """Return the information with more flat rows (N, w).

        Raises
        ------
        DataError
            When a row is not finite, because one NaN would destroy all information.
        """
        if not np.isfinite(flat.sum()):
            raise DataError("a sample of the equation of motion is not finite; mask it", "E413")
        return Information(self.layout, _updated(self.factor, flat), self.samples + len(flat))

    def discounted(self, share: float) -> "Information":
        """Return the information with every row's weight times ``share``, from 0 to 1."""
        if self.samples == 0:
            return self
        return Information(self.layout, np.sqrt(share) * self.factor, share * self.samples)

    def merge(self, other: "Information") -> "Information":
        """Return the sum of both informations.

        Raises
        ------
        DataError
            When they are about different robots or parameters.
        """
        if (self.layout.coordinates, self.layout.parameters) != (
            other.layout.coordinates,
            other.layout.parameters,
        ) or not np.array_equal(self.layout.structure, other.layout.structure):
            raise DataError(f"{INCOMPATIBLE}; use one model and the same terms", "E412")
        factor = _updated(self.factor, other.factor)
        return Information(self.layout, factor, self.samples + other.samples)

    def restricted(self, parameters: tuple[str, ...]) -> "Information":
        """Return the information about some parameters if the others are zero."""
        if parameters == self.layout.parameters:
            return self
        return _Restriction(self, self.layout.restricted(parameters))

    def column_squares(self, coordinate: int, column: int) -> float:
        """Return Σ K_ij² of coordinate i and parameter j; zero for a structural zero."""
        place = np.flatnonzero(self.layout.columns[coordinate] == column)
        start = self.layout.slices[coordinate].start
        return float(np.sum(self.factor[:, start + place] ** 2))

    def whitened(self, whitening: FloatArray) -> FloatArray:
        """Return the triangular factor of the rows weighted across coordinates.

        Parameters
        ----------
        whitening : (n, n) float64
            Weight G: each sample's rows become G [K y]. G is diagonal in Eq. 31. The inverse
            Cholesky factor of the residual covariance whitens the rows completely. An upper
            triangle takes less time, as the rows of later coordinates have fewer columns.

        Returns
        -------
        (p + 1, p + 1) float64
            Upper triangular factor of all rows G [K y].
        """
        layout = self.layout
        p = len(layout.parameters)
        stacked = [np.zeros((0, p + 1))]
        for row in whitening:
            used = np.flatnonzero(row)
            if not len(used):
                continue
            # Columns that no coordinate has would stay zero.
            some = np.append(np.flatnonzero(layout.structure[used].any(axis=0)), p)
            place = np.zeros(p, dtype=np.intp)
            place[some[:-1]] = np.arange(len(some) - 1)
            weighted = np.zeros((len(some), self._parts[used[-1]].shape[1]))
            for coordinate in used:
                part = row[coordinate] * self._parts[coordinate]
                # A slice of a triangle is zero below its last column; columns never repeat.
                weighted[place[layout.columns[coordinate]], : part.shape[1]] += part[:-1]
                weighted[-1, : part.shape[1]] += part[-1]
            few = compressed(weighted.T)
            wide = np.zeros((len(few), p + 1))
            wide[:, some] = few
            stacked.append(wide)
        return _triangle(np.concatenate(stacked))

    def whitened_moment(self, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) for a precision P (n, n) across coordinates.

        It has half the digits of :meth:`whitened` and takes a hundredth of its time. It serves
        quantities that are only estimated, and intermediate iterations.
        """
        if self._is_wide:
            return self.layout.column_groups.whitened_moment(self.factor, precision)
        width = len(self.layout.parameters) + 1
        half: FloatArray = (self._products @ precision.ravel()).reshape(width, width)
        return half + half.T

    @property
    def _is_wide(self) -> bool:
        """Whether moments are those of the rows themselves, without all pairs of columns."""
        return self.layout.width > WIDE

    def _columns(self, place: slice) -> FloatArray:
        """Return the factor's columns of one coordinate, without the zeros below a triangle."""
        is_triangle = len(self.factor) == self.layout.width
        return self.factor[: place.stop if is_triangle else None, place]

    @cached_property
    def _parts(self) -> tuple[FloatArray, ...]:
        """Each coordinate's columns of the factor, transposed."""
        return tuple(np.ascontiguousarray(self._columns(place).T) for place in self.layout.slices)

    @cached_property
    def coordinate_factors(self) -> tuple[FloatArray, ...]:
        """Triangular factor of [K_i y_i] of each coordinate, structural zeros omitted."""
        return tuple(_triangle(self._columns(place)) for place in self.layout.slices)

    @cached_property
    def _products(self) -> csr_array:
        """((p+1)(p+1), n n) half the moments of [K y], by pairs of coordinates."""
        # BLAS refuses a matrix without rows.
        factor = self.factor if len(self.factor) else np.zeros((1, self.layout.width))
        gram = blas.dsyrk(1.0, factor, trans=True)
        gram[np.diag_indices(len(gram))] /= 2
        return self.layout.moments_by_pair(gram)

    @cached_property
    def target_squares(self) -> FloatArray:
        """Σ y² (n,) over all samples."""
        ends = [place.stop - 1 for place in self.layout.slices]
        return np.asarray(np.sum(self.factor[:, ends] ** 2, axis=0))

    def residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return Σ e eᵀ (n, n) over all samples, e = y - K φ, for φ (p,)."""
        residual = np.column_stack(
            [
                self.factor[:, place] @ np.append(-phi[columns], 1.0)
                for columns, place in zip(self.layout.columns, self.layout.slices, strict=True)
            ]
        )
        moment: FloatArray = residual.T @ residual
        return moment

    def approximate_residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return :meth:`residual_moment` with half the digits, in a fifth of the time."""
        if self._is_wide:
            return self.residual_moment(phi)
        residual = np.append(-phi, 1.0)
        return self.quadratic_moment(np.outer(residual, residual))

    def quadratic_moment(self, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) over all samples for a symmetric X (p + 1, p + 1)."""
        if self._is_wide:
            return self.layout.column_groups.quadratic_moment(self.factor, matrix)
        n = len(self.layout.coordinates)
        half: FloatArray = (self._products.T @ matrix.ravel()).reshape(n, n)
        return half + half.T

    def residual_rmse(self, phi: FloatArray) -> dict[str, float]:
        """Return the root mean square of y - K φ per coordinate."""
        squares = np.diag(self.residual_moment(phi)) / max(self.samples, 1)
        return dict(zip(self.layout.coordinates, np.sqrt(squares).tolist(), strict=True))


class _Restriction(Information):
    """Information about some parameters if the others are zero.

    Moments are part of those of all parameters, whose products serve every choice of terms. The
    factor takes longer, and comparisons do not need it.
    """

    _whole: Information
    _kept: IntArray

    def __init__(self, whole: Information, layout: RowLayout) -> None:
        kept = [whole.layout.parameters.index(name) for name in layout.parameters]
        self.__dict__.update(
            layout=layout, samples=whole.samples, _whole=whole, _kept=np.array(kept, dtype=np.intp)
        )

    @cached_property
    def factor(self) -> FloatArray:
        """R (r, w) with RᵀR = Σ rowᵀ row."""
        return compressed(self._whole.factor[:, np.concatenate(self._places)])

    @property
    def _places(self) -> list[IntArray]:
        """Of each coordinate's columns in the flat rows of the whole, y last."""
        is_kept = np.zeros(len(self._whole.layout.parameters), dtype=bool)
        is_kept[self._kept] = True
        whole = self._whole.layout
        return [
            place.start + np.flatnonzero(np.append(is_kept[columns], True))
            for columns, place in zip(whole.columns, whole.slices, strict=True)
        ]

    @cached_property
    def _groups(self) -> ColumnGroups:
        return ColumnGroups(self.layout.structure, self._places)

    @property
    def _is_wide(self) -> bool:
        # Others have rows beside their factor.
        return type(self._whole) is Information and self._whole._is_wide

    def discounted(self, share: float) -> Information:
        """Return the information with every row's weight times ``share``, from 0 to 1."""
        return _Restriction(self._whole.discounted(share), self.layout)

    def restricted(self, parameters: tuple[str, ...]) -> Information:
        """Return the information about some parameters if the others are zero."""
        return self._whole.restricted(parameters)

    def column_squares(self, coordinate: int, column: int) -> float:
        """Return Σ K_ij² of coordinate i and parameter j; zero for a structural zero."""
        return self._whole.column_squares(coordinate, int(self._kept[column]))

    @cached_property
    def target_squares(self) -> FloatArray:
        """Σ y² (n,) over all samples."""
        return self._whole.target_squares

    def whitened_moment(self, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) for a precision P (n, n) across coordinates."""
        if self._is_wide:
            return self._groups.whitened_moment(self._whole.factor, precision)
        moment: FloatArray = self._whole.whitened_moment(precision)[self._block]
        return moment

    def residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return Σ e eᵀ (n, n) over all samples, e = y - K φ, for φ (p,)."""
        whole = np.zeros(len(self._whole.layout.parameters))
        whole[self._kept] = phi
        return self._whole.residual_moment(whole)

    def quadratic_moment(self, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) over all samples for a symmetric X (p + 1, p + 1)."""
        if self._is_wide:
            return self._groups.quadratic_moment(self._whole.factor, matrix)
        width = len(self._whole.layout.parameters) + 1
        whole = np.zeros((width, width))
        whole[self._block] = matrix
        return self._whole.quadratic_moment(whole)

    @property
    def _block(self) -> tuple[IntArray, ...]:
        """Places of the moments of [K y] in those of the whole."""
        some = np.append(self._kept, len(self._whole.layout.parameters))
        return np.ix_(some, some)


def _updated(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the factor with rows folded in."""
    width = factor.shape[1]
    if len(factor) < width:
        return compressed(np.concatenate([factor, rows]))
    # LAPACK overwrites its input, and the rows may be another information's factor.
    updated = factor.copy(order="F")
    fold_rows(updated, np.array(rows, order="F"))
    return updated


def compressed(rows: FloatArray) -> FloatArray:
    """Return at most w rows with the same moments as rows (N, w), triangular if there are w."""
    return rows if len(rows) < rows.shape[1] else _triangle(rows)


def stacked_factor(*blocks: FloatArray) -> FloatArray:
    """Return the square upper triangular factor of vertically stacked matrices (·, w)."""
    return _triangle(np.concatenate(blocks))


def _triangle(matrix: FloatArray) -> FloatArray:
    """Return the square upper triangular factor of a matrix, padded with zero rows."""
    width = matrix.shape[1]
    square = np.zeros((width, width))
    if len(matrix):  # SciPy of Ubuntu 24.04 rejects a matrix without rows
        (upper,) = qr(matrix, mode="r", check_finite=False)
        square[: min(len(upper), width)] = upper[:width]
    return square
