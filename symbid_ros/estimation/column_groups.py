"""Moments of wide rows, without those of all pairs of their columns.

The flat row of a robot with many joints has thousands of columns, as the row of each joint contains
the parameters of all links that the joint moves. Moments of all pairs of columns serve every weight
of the rows (:meth:`symbid_ros.estimation.row_layout.RowLayout.moments_by_pair`), but their memory
grows with the fourth power of the length of a chain. The rows themselves give the moments for one
weight in less time than it takes to form all pairs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray

# Numbers of weighted rows that are kept at once, 64 MB; and rows, below which products are slow.
NUMBERS_AT_ONCE, LEAST_ROWS = 8_000_000, 64


@dataclass(frozen=True)
class ColumnGroup:
    """Columns of [K y] that are non-zero in the same coordinates, such as those of one link.

    Attributes
    ----------
    coordinates : (m,) int
    place : slice
        Of the columns in the order of :attr:`ColumnGroups.order`.
    flat : (m, k) int
        Places of each coordinate's columns in the flat row.
    """

    coordinates: IntArray
    place: slice
    flat: IntArray


class ColumnGroups:
    """The columns of [K y], in groups that are non-zero in the same coordinates.

    Columns are in an order in which the first ones are those of the last coordinates. The columns
    of coordinate i and of all after it are thus the first ones.

    Parameters
    ----------
    structure : (n, p) bool
        Entries of K that are non-zero for some motion.
    flat : sequence of (c + 1,) int
        For each coordinate the places of its columns, y last, in the flat row.

    Attributes
    ----------
    order : (q,) int
        Columns of [K y] that are non-zero in some coordinate; p is y.
    groups : tuple of ColumnGroup
    """

    def __init__(self, structure: BoolArray, flat: Sequence[IntArray]) -> None:
        n, p = structure.shape
        self._count = p + 1
        whole = np.concatenate([structure, np.ones((n, 1), bool)], axis=1)
        places = np.full(whole.shape, -1)
        for row, used, own in zip(places, whole, flat, strict=True):
            row[used] = own
        last = np.where(whole.any(axis=0), n - 1 - whole[::-1].argmax(axis=0), -1)
        _, pattern = np.unique(whole, axis=1, return_inverse=True)
        pattern = pattern.ravel()
        self.order = np.lexsort((np.arange(p + 1), pattern, -last))
        self.order = self.order[last[self.order] >= 0]
        borders = np.flatnonzero(np.diff(pattern[self.order])) + 1
        groups, start = [], 0
        for columns in np.split(self.order, borders):
            coordinates = np.flatnonzero(whole[:, columns[0]])
            place = slice(start, start + len(columns))
            groups.append(ColumnGroup(coordinates, place, places[np.ix_(coordinates, columns)]))
            start = place.stop
        self.groups = tuple(groups)
        rank = np.full(p + 1, -1)
        rank[self.order] = np.arange(len(self.order))
        self._flat = tuple(flat)
        self._own = tuple(rank[np.flatnonzero(used)] for used in whole)
        # Columns of coordinate i and later ones.
        self._width = [int(np.count_nonzero(last >= i)) for i in range(n)]

    def whitened_moment(self, factor: FloatArray, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) of flat rows (r, w) and a symmetric P (n, n)."""
        # Pairs of coordinates in one order only; the others are the transposed ones.
        weight = np.triu(precision)
        weight[np.diag_indices(len(weight))] /= 2
        half = np.zeros((len(self.order), len(self.order)))
        for rows in self._parts(factor):
            weighted = np.zeros((len(weight), len(rows), len(self.order)))
            for group in self.groups:
                before = int(group.coordinates[-1]) + 1
                own = self._columns(rows, group)
                product = weight[:before, group.coordinates] @ own.reshape(len(own), -1)
                weighted[:before, :, group.place] = product.reshape(before, *own.shape[1:])
            for i, (flat, own) in enumerate(zip(self._flat, self._own, strict=True)):
                later = slice(0, self._width[i])
                half[own, later] += rows[:, flat].T @ weighted[i, :, later]
        moment = np.zeros((self._count, self._count))
        moment[np.ix_(self.order, self.order)] = half + half.T
        return moment

    def quadratic_moment(self, factor: FloatArray, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) of flat rows (r, w) and a symmetric X (p + 1, p + 1)."""
        n = len(self._own)
        inner = matrix[np.ix_(self.order, self.order)]
        upper = np.zeros((n, n))
        for rows in self._parts(factor):
            products = np.zeros((n, len(rows), len(self.order)))
            for i, (flat, own) in enumerate(zip(self._flat, self._own, strict=True)):
                later = slice(0, self._width[i])
                products[i, :, later] = rows[:, flat] @ inner[own, later]
            for group in self.groups:
                before = int(group.coordinates[-1]) + 1
                own = self._columns(rows, group)
                part = products[:before, :, group.place].reshape(before, -1)
                upper[:before, group.coordinates] += part @ own.reshape(len(own), -1).T
        return np.asarray(np.triu(upper) + np.triu(upper, 1).T)

    def _parts(self, factor: FloatArray) -> Iterator[FloatArray]:
        """Yield the rows, a few at a time."""
        size = len(self._own) * len(self.order)
        step = max(NUMBERS_AT_ONCE // size, LEAST_ROWS)
        for first in range(0, len(factor), step):
            yield factor[first : first + step]

    @staticmethod
    def _columns(rows: FloatArray, group: ColumnGroup) -> FloatArray:
        """Return a group's columns (m, N, k) in each of its coordinates."""
        return np.ascontiguousarray(rows[:, group.flat].transpose(1, 0, 2))
