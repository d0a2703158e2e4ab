"""Moments of each joint's own rows, by groups of seconds, for cross-validation by blocks.

A joint term affects its own joint's rows only. So whether the term predicts rows that were not
used can be told from the moments of these rows alone, group by group, without a second pass over
the data.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.estimation.information import Information, RowLayout
from symbid_ros.signals.weak_form import WindowedRows

# Seconds of a log are dealt to this many groups in turn. Residuals of neighbouring rows are
# correlated, so rows are left out by whole seconds.
GROUPS = 8
SECOND = 1_000_000_000


@dataclass(frozen=True)
class GroupMoments:
    """Moments Σ [K_i y_i]ᵀ [K_i y_i] of each joint's rows in each group.

    Attributes
    ----------
    layout : RowLayout
        Layout of the rows.
    moments : tuple of (GROUPS, c + 1, c + 1) float64
        For each coordinate with a parameter of its own, in the order of ``coordinates``; its c
        columns are those of the layout.
    counts : (GROUPS, n) float64
        Valid rows of each coordinate in each group.
    """

    layout: RowLayout
    moments: tuple[FloatArray, ...]
    counts: FloatArray

    @classmethod
    def empty(cls, layout: RowLayout) -> "GroupMoments":
        """Return the moments of no data."""
        sizes = [len(layout.columns[i]) + 1 for i in layout.own_coordinates]
        moments = tuple(np.zeros((GROUPS, size, size)) for size in sizes)
        return cls(layout, moments, np.zeros((GROUPS, len(layout.coordinates))))

    def fold(self, blocks: Iterable[WindowedRows]) -> "GroupMoments":
        """Return the moments with more rows."""
        moments = [each.copy() for each in self.moments]
        counts = self.counts.copy()
        for block in blocks:
            group = (block.stamp // SECOND) % GROUPS
            np.add.at(counts, group, block.valid)
            for each, coordinate in zip(moments, self.layout.own_coordinates, strict=True):
                rows = _rows_of(block.mean, coordinate, self.layout)
                for one in np.unique(group):
                    some = rows[group == one]
                    each[one] += some.T @ some
        return GroupMoments(self.layout, tuple(moments), counts)

    def discounted(self, share: float) -> "GroupMoments":
        """Return the moments with every row's weight times ``share``, from 0 to 1."""
        moments = tuple(share * each for each in self.moments)
        return GroupMoments(self.layout, moments, share * self.counts)

    def merge(self, other: "GroupMoments") -> "GroupMoments":
        """Return the sum of both, which have the same layout."""
        both = zip(self.moments, other.moments, strict=True)
        return GroupMoments(
            self.layout, tuple(one + two for one, two in both), self.counts + other.counts
        )

    def correlation(self, phi: FloatArray, information: Information) -> FloatArray:
        """Return by how much residuals at φ (p,) vary more from group to group than white noise.

        Parameters
        ----------
        phi : (p,) float64
            Parameters that fit all groups together.
        information : Information
            Of the same rows.

        Returns
        -------
        (n,) float64
            At least 1. Mean over the columns k of a coordinate's rows of the variance of Σ k e in
            a group, over that of independent residuals e; a coordinate without moments gets the
            mean of the others.
        """
        layout = self.layout
        ratios = np.ones(len(layout.coordinates))
        total = information.residual_moment(phi).diagonal()
        for moment, coordinate in zip(self.moments, layout.own_coordinates, strict=True):
            count = self.counts[:, coordinate].sum()
            used = np.flatnonzero(self.counts[:, coordinate] > 0)
            if len(used) < 2 or count == 0:
                continue
            value = np.append(-phi[layout.columns[coordinate]], 1.0)
            scores = (moment[used] @ value)[:, :-1]
            scores = scores - scores.mean(axis=0)
            squares = np.einsum("gcc->c", moment)[:-1]
            moves = squares > 1e-12 * squares.max(initial=0.0)
            expected = total[coordinate] / count * squares[moves]
            found = np.sum(scores[:, moves] ** 2, axis=0) * len(used) / (len(used) - 1)
            if moves.any() and total[coordinate] > 0:
                ratios[coordinate] = float(np.mean(found / expected))
        return np.maximum(ratios, 1.0)


def _rows_of(rows: Rows, coordinate: int, layout: RowLayout) -> FloatArray:
    """Return [K_i y_i] (N, c + 1) of one coordinate."""
    return np.column_stack(
        [rows.K[:, coordinate, layout.columns[coordinate]], rows.y[:, coordinate]]
    )
