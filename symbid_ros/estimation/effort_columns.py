"""Information of rows in which efforts of unknown unit are columns, for any factors.

A joint's effort is a factor k times the reading u. Its row is K φ - u k = w, with all other forces
in w. Rows for given factors, and rows linearised in them, are linear combinations of the columns of
[K, -u, w], so that one pass over a log serves all steps of an iteration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.group_moments import CoordinateMoments, CoordinateRows, GroupMoments
from symbid_ros.estimation.information import Information, compressed
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout


@dataclass(frozen=True)
class EffortColumns:
    """Which columns of rows are efforts of unknown unit.

    Attributes
    ----------
    layout : RowLayout
        Of rows K φ - u k = w. The factors k are the last parameters, each in one coordinate.
    count : int
        Number of factors r.
    """

    layout: RowLayout
    count: int

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the other parameters φ."""
        return self.layout.parameters[: -self.count]

    def restricted(self, parameters: tuple[str, ...]) -> "EffortColumns":
        """Return the columns of some of the parameters φ and of all factors."""
        factors = self.layout.parameters[-self.count :]
        return EffortColumns(self.layout.restricted((*parameters, *factors)), self.count)

    def converted(self, rows: Observations, factors: FloatArray) -> Observations:
        """Return the rows K φ = w + u k for given factors k (r,)."""
        layout = self.layout.restricted(self.parameters)
        return _combined(rows, layout, self._combinations(factors))

    def linearised(self, rows: Observations, phi: FloatArray, factors: FloatArray) -> Observations:
        """Return the rows linearised about φ₀ (p,) and k₀ (r,).

        They are K φ - (τ/k₀) k = w + u k₀ - τ with the effort τ = K φ₀ - w that the model needs.
        The measured one contains noise, with which small factors and small masses would look more
        probable.
        """
        return _combined(rows, self.layout, self._combinations(factors, phi))

    def beside(self, rows: Observations, phi: FloatArray) -> Observations:
        """Return rows K φ = u with the factors, which are about one, as further unknowns.

        The given rows have no columns of efforts, and all forces are efforts. They are linearised
        about the parameters ``phi`` (p,).
        """
        combinations = self._combinations(np.ones(self.count), phi)
        for index, columns in enumerate(self.layout.columns):
            if len(columns) and columns[-1] >= len(self.parameters):  # w is zero, and y is u
                one = combinations[index]
                combinations[index] = np.vstack([one[:-2], -one[-2]])
        return _combined(rows, self.layout, combinations)

    def _combinations(self, factors: FloatArray, phi: FloatArray | None = None) -> list[FloatArray]:
        """Return the combinations (c, c') of each coordinate's columns [K, -u, w].

        Without ``phi``, those of :meth:`converted`.
        """
        first = len(self.parameters)
        found = []
        for columns in self.layout.columns:
            one = np.eye(len(columns) + 1)
            found.append(one)
            if not len(columns) or columns[-1] < first:
                continue
            factor, own = factors[columns[-1] - first], columns[:-1]
            one[-2, -1] = -factor
            if phi is None:
                found[-1] = np.delete(one, -2, axis=1)
            else:
                one[:-2, -2], one[-2, -2], one[-1, -2] = -phi[own] / factor, 0.0, 1 / factor
                one[:-2, -1], one[-1, -1] = -phi[own], 2.0
        return found


def _combined(
    rows: Observations, layout: RowLayout, combinations: Sequence[FloatArray]
) -> Observations:
    """Return rows of another layout, with combinations (c, c') of each coordinate's columns."""

    def information(of: Information) -> Information:
        parts = [
            of.factor[:, place] @ one
            for place, one in zip(of.layout.slices, combinations, strict=True)
        ]
        return Information(layout, compressed(np.concatenate(parts, axis=1)), of.samples)

    return replace(
        rows,
        rows=information(rows.rows),
        noise=information(rows.noise),
        groups=rows.groups and _combined_moments(rows.groups, layout, combinations),
        slipping=rows.slipping and _combined(rows.slipping, layout, combinations),
    )


def _combined_moments(
    moments: GroupMoments, layout: RowLayout, combinations: Sequence[FloatArray]
) -> GroupMoments:
    parts: list[CoordinateMoments | CoordinateRows] = []
    for part in moments.parts:
        one = combinations[part.coordinate]
        if isinstance(part, CoordinateRows):
            rows = [each @ one for each in part.rows]
            parts.append(CoordinateRows.compact(part.coordinate, rows))
            continue
        before, after = one.shape
        sums = part.moments @ one
        if len(part.left) == before:
            left, sums = np.arange(after), one.T @ sums
        else:  # of the columns whose scores are compared, those that stay as they are
            same = np.all(one == np.eye(before, after), axis=0)
            kept = np.isin(part.left, np.flatnonzero(same))
            left, sums = part.left[kept], sums[:, kept]
        parts.append(CoordinateMoments(part.coordinate, left, sums))
    return GroupMoments(layout, tuple(parts), moments.counts)
