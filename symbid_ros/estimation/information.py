"""Information of the data about the parameters, in one triangular factor.

QR updates fold in rows as they arrive, and rows are not stored. The factor of *flat* sample rows
is enough, without a second pass over the data, for:

- the least-squares problem with any covariance of the residuals across coordinates, any column
  scaling, prior or truncation,
- the residual of any parameter vector.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import blas, qr
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import TERMS
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import combined_coordinates, possible_states
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.qr_update import fold_rows
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

# Rows that are folded at once: LAPACK takes half the time per row for many as for few.
ROWS_AT_ONCE = 512

INCOMPATIBLE = "information about different robots or parameters cannot be merged"


@dataclass(frozen=True)
class RowLayout:
    """Layout of a flat sample row: for each coordinate its structural non-zeros of K, then its y.

    Attributes
    ----------
    coordinates : tuple of str
        Names of the n coordinates.
    parameters : tuple of str
        Names of the p parameters.
    structure : (n, p) bool
        Entries of K that are non-zero for some motion.
    combined : tuple of int
        Coordinates whose rows are orthonormal combinations of several, without unmeasured contacts.
    """

    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    structure: BoolArray
    combined: tuple[int, ...] = ()

    @classmethod
    def of(cls, parameters: ParameterSet) -> "RowLayout":
        """Find the structure of a robot's regressor from noise-free random motions.

        Raises
        ------
        EstimateError
            When no part of the robot can move.
        """
        model = parameters.model
        samples = replace(random_motions(model, 20), stamp=parameters.typical_stamps(20))
        K = np.zeros((model.dof, len(parameters)))
        # Rows depend on which contacts touch something, if that is known.
        for touching in possible_states(model) or (None,):
            state = None if touching is None else np.tile(touching, (len(samples), 1))
            rows = equation_of_motion(parameters, replace(samples, touching=state))
            K = np.maximum(K, np.abs(rows.K).max(axis=0))
        # Structural zeros still contain rounding, relative to their column or row.
        structure = 1e-10 * np.maximum(K.max(axis=0), K.max(axis=1, keepdims=True)) < K
        return cls(model.coordinates, parameters.names, structure, combined_coordinates(model))

    def extended(self, names: tuple[str, ...], structure: BoolArray) -> "RowLayout":
        """Return the layout with more parameters, non-zero in the coordinates ``structure``."""
        return RowLayout(
            self.coordinates,
            self.parameters + names,
            np.concatenate([self.structure, structure], axis=1),
            self.combined,
        )

    def restricted(self, parameters: tuple[str, ...]) -> "RowLayout":
        """Return the layout with some of the parameters, in the same order."""
        if parameters not in self._restrictions:
            kept = [self.parameters.index(name) for name in parameters]
            self._restrictions[parameters] = RowLayout(
                self.coordinates, parameters, self.structure[:, kept], self.combined
            )
        return self._restrictions[parameters]

    @cached_property
    def _restrictions(self) -> dict[tuple[str, ...], "RowLayout"]:
        """Layouts with some of the parameters; one object for each, for what it caches."""
        return {}

    @cached_property
    def own_coordinates(self) -> tuple[int, ...]:
        """Coordinates with a parameter that affects no other."""
        own = self.structure[:, self.structure.sum(axis=0) == 1]
        return tuple(np.flatnonzero(own.any(axis=1)).tolist())

    @cached_property
    def term_coordinates(self) -> frozenset[int]:
        """Coordinates that a joint term or an own parameter affects."""
        is_term = [name.rpartition("/")[2] in TERMS for name in self.parameters]
        affected = np.flatnonzero(self.structure[:, is_term].any(axis=1))
        return frozenset([*affected.tolist(), *self.own_coordinates])

    @property
    def width(self) -> int:
        """Length w of the flat row."""
        return int(self.structure.sum()) + len(self.coordinates)

    @cached_property
    def columns(self) -> tuple[IntArray, ...]:
        """Per coordinate the indices of its parameters, in the flat row's order."""
        return tuple(np.flatnonzero(row) for row in self.structure)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Per coordinate its slice of the flat row, y last."""
        ends = np.cumsum([len(columns) + 1 for columns in self.columns])
        return tuple(
            slice(int(end) - len(columns) - 1, int(end))
            for end, columns in zip(ends, self.columns, strict=True)
        )

    @cached_property
    def _moment_pattern(self) -> csr_array:
        """Places in a flat moment (w w,) of the entries of :meth:`moments_by_pair`."""
        n, p = len(self.columns), len(self.parameters)
        coordinate = np.repeat(np.arange(n), [len(each) + 1 for each in self.columns])
        column = np.concatenate([np.append(each, p) for each in self.columns])
        one, other = np.triu_indices(self.width)
        rows = column[one] * (p + 1) + column[other]
        pairs = coordinate[one] * n + coordinate[other]
        places = one + self.width * other  # in Fortran order, as BLAS returns the moment
        return csr_array((places, (rows, pairs)), shape=((p + 1) ** 2, n**2))

    def moments_by_pair(self, gram: FloatArray) -> csr_array:
        """Return the moments of [K y] by pairs of coordinates, from those of the flat rows.

        Parameters
        ----------
        gram : (w, w) float64
            Upper triangle of Σ rowᵀ row of flat rows, in Fortran order, with half its diagonal.

        Returns
        -------
        ((p + 1) (p + 1), n n) csr_array
            X with X + Xᵀ the moment Σ [K y]ᵀ P [K y], where X is the product with a flat symmetric
            precision P (n, n) across coordinates.
        """
        pattern = self._moment_pattern  # sorted once for each layout
        data = gram.ravel(order="F")[pattern.data]
        return csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)

    def flatten(self, blocks: Sequence[Rows]) -> FloatArray:
        """Return the flat rows (N, w) of all samples of blocks."""
        flat = np.empty((sum(len(rows.y) for rows in blocks), self.width))
        first = 0
        for rows in blocks:
            part = flat[first : first + len(rows.y)]
            for i, (columns, place) in enumerate(zip(self.columns, self.slices, strict=True)):
                part[:, place.start : place.stop - 1] = rows.K[:, i, columns]
                part[:, place.stop - 1] = rows.y[:, i]
            first += len(part)
        return flat

    def spread(self, values: BoolArray) -> BoolArray:
        """Return values of coordinates (N, n) for all columns of the flat rows (N, w)."""
        return np.repeat(values, [place.stop - place.start for place in self.slices], axis=1)


def random_motions(model: RobotModel, count: int) -> Samples:
    """Return ``count`` noise-free random states and accelerations, the same in every call.

    Rates and accelerations are of order one in SI units, joint limits are ignored, and nothing
    touches the robot.

    Raises
    ------
    EstimateError
        When no part of the robot can move.
    """
    if not model.coordinates:
        raise EstimateError(
            f"{model.source}: its base is fixed and no joint moves, so its inertia has no effect; "
            "give a model with joints, or `base` floating",
            "E419",
        )
    rng = np.random.default_rng(0)
    joints, base = (count, len(model.joints)), (3, count, 3)
    motion = rng.normal(size=base) if model.floating else np.zeros(base)
    if not model.floating:
        motion[2] = -model.gravity
    return Samples(
        stamp=np.arange(count, dtype=np.int64),
        position=model.apply_mimics(rng.uniform(-np.pi, np.pi, joints)),
        velocity=model.apply_mimics(rng.normal(size=joints), rates=True),
        acceleration=model.apply_mimics(rng.normal(size=joints), rates=True),
        effort=np.zeros(joints),
        base_angular_velocity=motion[0],
        base_angular_acceleration=motion[1],
        base_specific_force=motion[2],
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )


@dataclass(frozen=True)
class Information:
    """The triangular factor of all flat rows so far.

    Attributes
    ----------
    layout : RowLayout
        Layout of the flat rows.
    factor : (w, w) float64
        Upper triangular R with RᵀR = Σ rowᵀ row.
    samples : float
        Number of samples folded in; the effective number if old ones are discounted.
    """

    layout: RowLayout
    factor: FloatArray
    samples: float

    @classmethod
    def empty(cls, layout: RowLayout) -> "Information":
        """Return the information of no data."""
        return cls(layout, np.zeros((layout.width, layout.width), order="F"), 0)

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
        factor = _updated(self.factor.copy(order="F"), flat)
        return Information(self.layout, factor, self.samples + len(flat))

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
        factor = _updated(self.factor.copy(order="F"), other.factor)
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

    def coordinate_factor(self, coordinate: int) -> FloatArray:
        """Return the triangular factor of [K_i y_i] of one coordinate, structural zeros omitted."""
        return self._coordinate_factors[coordinate]

    def whitened(self, whitening: FloatArray) -> FloatArray:
        """Return the triangular factor of the rows weighted across coordinates.

        Parameters
        ----------
        whitening : (n, n) float64
            Weight G: each sample's rows become G [K y]. G is diagonal in Eq. 31. The inverse
            Cholesky factor of the residual covariance whitens the rows completely.

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
                # A slice of a triangle is zero below its last column; columns never repeat.
                weighted[layout.columns[coordinate], : part.shape[1]] += part[:-1]
                weighted[p, : part.shape[1]] += part[-1]
            stacked.append(_triangle(weighted.T))
        return _triangle(np.concatenate([np.zeros((p + 1, p + 1)), *stacked]))

    def whitened_moment(self, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) for a precision P (n, n) across coordinates.

        It has half the digits of :meth:`whitened` and takes a hundredth of its time. It serves
        quantities that are only estimated, and intermediate iterations.
        """
        width = len(self.layout.parameters) + 1
        half: FloatArray = (self._products @ precision.ravel()).reshape(width, width)
        return half + half.T

    @cached_property
    def _is_filled(self) -> BoolArray:
        """(w,) rows of the factor that are not zero; few samples fill few rows of a wide factor.

        At least one row is kept, because BLAS refuses matrices without rows.
        """
        size = np.abs(self.factor).max(axis=1, initial=0.0)
        filled = size > 1e-15 * size.max(initial=0.0)
        filled[:1] |= not filled.any()
        return np.asarray(filled)

    @cached_property
    def _filled(self) -> FloatArray:
        """The factor without its zero rows."""
        if self._is_filled.all():
            return self.factor
        return np.asfortranarray(self.factor[self._is_filled])

    @cached_property
    def _parts(self) -> tuple[FloatArray, ...]:
        """Each coordinate's slice of the factor, transposed, without its zero rows."""
        return tuple(
            np.ascontiguousarray(self.factor[: place.stop, place][self._is_filled[: place.stop]].T)
            for place in self.layout.slices
        )

    @cached_property
    def _coordinate_factors(self) -> tuple[FloatArray, ...]:
        # Below row `place.stop` these columns of a triangle are zero.
        return tuple(_triangle(self.factor[: place.stop, place]) for place in self.layout.slices)

    @cached_property
    def _products(self) -> csr_array:
        """((p+1)(p+1), n n) half the moments of [K y], by pairs of coordinates."""
        # BLAS refuses a matrix without rows.
        filled = self._filled if len(self._filled) else np.zeros((1, self.layout.width))
        gram = blas.dsyrk(1.0, filled, trans=True)
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
                self._filled[:, place] @ np.append(-phi[columns], 1.0)
                for columns, place in zip(self.layout.columns, self.layout.slices, strict=True)
            ]
        )
        moment: FloatArray = residual.T @ residual
        return moment

    def approximate_residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return :meth:`residual_moment` with half the digits, in a fifth of the time."""
        residual = np.append(-phi, 1.0)
        return self.quadratic_moment(np.outer(residual, residual))

    def quadratic_moment(self, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) over all samples for a symmetric X (p + 1, p + 1)."""
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
        """Upper triangular R (w, w) with RᵀR = Σ rowᵀ row."""
        is_kept = np.zeros(len(self._whole.layout.parameters), dtype=bool)
        is_kept[self._kept] = True
        used = [np.append(is_kept[columns], True) for columns in self._whole.layout.columns]
        return _triangle(self._whole.factor[:, np.concatenate(used)])

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
        moment: FloatArray = self._whole.whitened_moment(precision)[self._block]
        return moment

    def residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return Σ e eᵀ (n, n) over all samples, e = y - K φ, for φ (p,)."""
        whole = np.zeros(len(self._whole.layout.parameters))
        whole[self._kept] = phi
        return self._whole.residual_moment(whole)

    def quadratic_moment(self, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) over all samples for a symmetric X (p + 1, p + 1)."""
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
    """Return the triangular factor, which is overwritten, with rows folded in."""
    # LAPACK overwrites its input, and the rows may be another information's factor.
    fold_rows(factor, np.array(rows, order="F"))
    return factor


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
