"""Rows of the equation of motion, folded coordinate by coordinate.

The doctor weighs coordinates against each other but asks nothing of how their residuals go
together. Many small triangles then say all that the one wide triangle of identification does,
in a fraction of its time.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.estimation.information import stacked_factor


@dataclass
class CoordinateRows:
    """Triangular factors of [K_i y_i], one for each of n coordinates.

    Attributes
    ----------
    coordinates : tuple of str
        Their names.
    structure : (n, q) bool
        Which of q unknowns each of them feels.
    samples : int
        Rows folded into each factor.
    """

    coordinates: tuple[str, ...]
    structure: BoolArray
    samples: int = 0
    _columns: list[IntArray] = field(init=False)
    _factors: list[FloatArray] = field(init=False)

    def __post_init__(self) -> None:
        """Begin without data."""
        self._columns = [np.flatnonzero(row) for row in self.structure]
        widths = [len(columns) + 1 for columns in self._columns]
        self._factors = [np.zeros((width, width), order="F") for width in widths]

    def fold(self, rows: Rows) -> None:
        """Take N more rows of every coordinate."""
        for index, columns in enumerate(self._columns):
            block = np.empty((len(rows.y), len(columns) + 1), order="F")
            block[:, :-1] = rows.K[:, index, columns]
            block[:, -1] = rows.y[:, index]
            # LAPACK's tpqrt leaves the zeros of the triangle alone.
            self._factors[index], _, _, _ = lapack.dtpqrt(
                0, min(32, len(columns) + 1), self._factors[index], block, True, True
            )
        self.samples += len(rows.y)

    def whitened(self, deviation: FloatArray) -> FloatArray:
        """Return the triangle (q + 1, q + 1) of all rows over deviations (n,)."""
        q = self.structure.shape[1]
        stacked = np.zeros((sum(map(len, self._factors)), q + 1))
        first = 0
        for columns, factor, scale in zip(self._columns, self._factors, deviation, strict=True):
            rows = slice(first, first + len(factor))
            stacked[rows, columns] = factor[:, :-1] / scale
            stacked[rows, q] = factor[:, -1] / scale
            first += len(factor)
        return stacked_factor(stacked)

    def residual_squares(self, unknowns: FloatArray) -> FloatArray:
        """Return the mean squares (n,) of y - K x for x (q,)."""
        squares = [
            np.sum((factor[:, -1] - factor[:, :-1] @ unknowns[columns]) ** 2)
            for columns, factor in zip(self._columns, self._factors, strict=True)
        ]
        return np.array(squares) / max(self.samples, 1)

    @property
    def target_squares(self) -> FloatArray:
        """Mean squares (n,) of y."""
        return self.residual_squares(np.zeros(self.structure.shape[1]))

    def column_squares(self, coordinate: int, unknown: int) -> float:
        """Return the mean square of one unknown's column in one coordinate's rows."""
        place = int(np.searchsorted(self._columns[coordinate], unknown))
        column = self._factors[coordinate][:, place]
        return float(column @ column) / max(self.samples, 1)
