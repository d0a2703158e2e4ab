"""Moments of each coordinate's rows, by groups of seconds.

Residuals of a wrong model are correlated in time, so they carry less information than as many
independent ones. How much less follows from the scores Σ k e of a coordinate's columns k and
residuals e: over groups of seconds, their variance exceeds that of independent residuals. A joint
term affects its own joint's rows only, so the same moments show whether it predicts rows that were
not used. Neither needs a second pass over the data.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.signals.weak_form import WindowedRows

# Seconds of a log are dealt to this many groups in turn. Residuals of neighbouring rows are
# correlated, so rows are left out by whole seconds.
GROUPS = 8
SECOND = 1_000_000_000
# Columns of a coordinate whose scores are compared, evenly spread, if no terms are to be chosen.
COLUMNS = 12


@dataclass(frozen=True)
class Grouping:
    """Which group a row belongs to: seconds of a log are dealt in turn, or each has a long part.

    Attributes
    ----------
    borders : tuple of int
        Stamps between contiguous groups, ns; empty if seconds are dealt to the groups.
    """

    borders: tuple[int, ...] = ()

    @classmethod
    def contiguous(cls, spans: Sequence[tuple[int, int]]) -> "Grouping":
        """Return the grouping into parts of equal recorded time: spans without pauses, ns."""
        lengths = np.array([stop - start for start, stop in spans])
        ends = np.cumsum(lengths)
        borders = []
        for elapsed in (int(ends[-1]) * number // GROUPS for number in range(1, GROUPS)):
            place = int(np.searchsorted(ends, elapsed))
            borders.append(spans[place][1] - int(ends[place]) + elapsed)
        return cls(tuple(borders))

    def of(self, stamp: IntArray) -> IntArray:
        """Return the groups (N,) of rows at stamps (N,), ns."""
        if self.borders:
            return np.searchsorted(np.array(self.borders), stamp, side="right")
        groups: IntArray = stamp // SECOND % GROUPS
        return groups


BY_SECONDS = Grouping()


@dataclass(frozen=True)
class CoordinateMoments:
    """Moments of one coordinate's rows in each group.

    Attributes
    ----------
    coordinate : int
    left : (r,) int
        Places of some of the c + 1 columns of [K_i y_i].
    moments : (GROUPS, r, c + 1) float64
        Σ [K_i y_i]ᵀ [K_i y_i], of these columns with all.
    """

    coordinate: int
    left: IntArray
    moments: FloatArray

    def ratio(self, phi: FloatArray, counts: FloatArray, variance: float) -> float:
        """Return the variance of scores over that of independent residuals; NaN if unknown.

        ``phi`` (c,) are the parameters of the columns, ``counts`` (GROUPS,) the rows in each group,
        and ``variance`` is that of a residual.
        """
        is_column = self.left < len(phi)
        left = self.left[is_column]
        moments = self.moments[:, is_column]
        squares = moments[:, np.arange(len(left)), left]
        return _ratio(moments @ np.append(-phi, 1.0), squares, counts, variance)

    def folded(self, rows: FloatArray, ends: Sequence[int]) -> "CoordinateMoments":
        """Return the moments with more rows (N, c + 1), those of a group between two ends."""
        moments = self.moments.copy()
        is_complete = len(self.left) == rows.shape[1]
        for one, (start, stop) in enumerate(pairwise(ends)):
            if start < stop:
                some = rows[start:stop]
                moments[one] += (some if is_complete else some[:, self.left]).T @ some
        return replace(self, moments=moments)

    def discounted(self, share: float) -> "CoordinateMoments":
        """Return the moments with every row's weight times ``share``."""
        return replace(self, moments=share * self.moments)

    def restricted(self, kept: BoolArray) -> "CoordinateMoments":
        """Return the moments of the columns ``kept`` (c,), and of y."""
        used = np.append(kept, True)
        place, some = np.cumsum(used) - 1, used[self.left]
        moments = self.moments[:, some][:, :, used]
        return CoordinateMoments(self.coordinate, place[self.left[some]], moments)


@dataclass(frozen=True)
class CoordinateRows:
    """Rows of one coordinate in each group, which stand for all their moments if they are few.

    Attributes
    ----------
    coordinate : int
    rows : tuple of (m, c + 1) float64
        Rows [K_i y_i] of each group.
    """

    coordinate: int
    rows: tuple[FloatArray, ...]

    @classmethod
    def compact(
        cls, coordinate: int, rows: Sequence[FloatArray]
    ) -> "CoordinateRows | CoordinateMoments":
        """Return the rows, or their moments where a group has more rows than columns."""
        found = cls(coordinate, tuple(rows))
        width = rows[0].shape[1]
        if max(map(len, rows)) <= width:
            return found
        return CoordinateMoments(coordinate, found.left, found.moments)

    @property
    def left(self) -> IntArray:
        """Places of all c + 1 columns."""
        return np.arange(self.rows[0].shape[1])

    @property
    def moments(self) -> FloatArray:
        """(GROUPS, c + 1, c + 1) Σ [K_i y_i]ᵀ [K_i y_i]."""
        return np.array([one.T @ one for one in self.rows])

    def ratio(self, phi: FloatArray, counts: FloatArray, variance: float) -> float:
        """Return what :meth:`CoordinateMoments.ratio` does."""
        scores = np.array([one[:, :-1].T @ (one[:, -1] - one[:, :-1] @ phi) for one in self.rows])
        squares = np.array([np.sum(one[:, :-1] ** 2, axis=0) for one in self.rows])
        return _ratio(scores, squares, counts, variance)

    def folded(self, rows: FloatArray, ends: Sequence[int]) -> "CoordinateRows | CoordinateMoments":
        """Return the rows with more (N, c + 1), those of a group between two ends."""
        more = [rows[start:stop] for start, stop in pairwise(ends)]
        return self.compact(
            self.coordinate, [np.concatenate(both) for both in zip(self.rows, more, strict=True)]
        )

    def discounted(self, share: float) -> "CoordinateRows":
        """Return the rows with every row's weight times ``share``."""
        return replace(self, rows=tuple(np.sqrt(share) * one for one in self.rows))

    def restricted(self, kept: BoolArray) -> "CoordinateRows | CoordinateMoments":
        """Return the rows of the columns ``kept`` (c,), and of y."""
        used = np.append(kept, True)
        return self.compact(self.coordinate, [one[:, used] for one in self.rows])


def _ratio(scores: FloatArray, squares: FloatArray, counts: FloatArray, variance: float) -> float:
    """Return the variance of scores (GROUPS, k) over that of independent residuals.

    ``squares`` (GROUPS, k) are those of the columns, and ``counts`` (GROUPS,) numbers of rows. The
    ratio is NaN if it is unknown.
    """
    used = np.flatnonzero(counts > 0)
    if len(used) < 2 or not scores.shape[1] or variance <= 0:
        return np.nan
    squares, scores = squares[used].sum(axis=0), scores[used]
    moves = squares > 1e-12 * squares.max(initial=0.0)
    if not moves.any():
        return np.nan
    share = counts[used] / counts.sum()
    scores = scores - share[:, None] * scores.sum(axis=0)
    found = np.sum(scores[:, moves] ** 2, axis=0) / (1 - np.sum(share**2))
    return float(np.mean(found / (variance * squares[moves])))


@dataclass(frozen=True)
class GroupMoments:
    """Moments of the rows of all coordinates in each group.

    Attributes
    ----------
    layout : RowLayout
        Layout of the rows.
    parts : tuple of CoordinateMoments or CoordinateRows
        Of each coordinate that has columns.
    counts : (GROUPS, n) float64
        Valid rows of each coordinate in each group.
    grouping : Grouping
    """

    layout: RowLayout
    parts: tuple[CoordinateMoments | CoordinateRows, ...]
    counts: FloatArray
    grouping: Grouping = BY_SECONDS

    @classmethod
    def empty(
        cls, layout: RowLayout, *, candidates: bool = False, grouping: Grouping = BY_SECONDS
    ) -> "GroupMoments":
        """Return the moments of no data; all moments of joints whose terms are candidates."""
        complete = layout.term_coordinates if candidates else frozenset()
        parts: list[CoordinateMoments | CoordinateRows] = []
        for coordinate, columns in enumerate(layout.columns):
            count = len(columns)
            if not count:
                continue
            if coordinate in complete:
                nothing = np.zeros((0, count + 1))
                parts.append(CoordinateRows(coordinate, (nothing,) * GROUPS))
                continue
            left = np.unique(np.linspace(0, count - 1, min(COLUMNS, count)).astype(int))
            parts.append(
                CoordinateMoments(coordinate, left, np.zeros((GROUPS, len(left), count + 1)))
            )
        return cls(layout, tuple(parts), np.zeros((GROUPS, len(layout.coordinates))), grouping)

    @property
    def complete(self) -> tuple[CoordinateMoments | CoordinateRows, ...]:
        """The coordinates with all moments, those of joints whose terms are candidates."""
        columns = self.layout.columns
        return tuple(
            each for each in self.parts if len(each.left) == len(columns[each.coordinate]) + 1
        )

    def fold(self, blocks: Iterable[WindowedRows]) -> "GroupMoments":
        """Return the moments with more rows averaged over windows."""
        found = self
        for block in blocks:
            found = found.fold_flat(self.layout.flatten([block.mean]), block.valid, block.stamp)
        return found

    def fold_flat(self, flat: FloatArray, valid: BoolArray, stamp: IntArray) -> "GroupMoments":
        """Return the moments with more flat rows (N, w), valid at some coordinates (N, n)."""
        group = self.grouping.of(stamp)
        counts = self.counts.copy()
        np.add.at(counts, group, valid)
        order = np.argsort(group, kind="stable")
        flat, ends = flat[order], np.searchsorted(group[order], np.arange(GROUPS + 1)).tolist()
        parts = (
            part.folded(flat[:, self.layout.slices[part.coordinate]], ends) for part in self.parts
        )
        return replace(self, parts=tuple(parts), counts=counts)

    def discounted(self, share: float) -> "GroupMoments":
        """Return the moments with every row's weight times ``share``, from 0 to 1."""
        parts = tuple(part.discounted(share) for part in self.parts)
        return replace(self, parts=parts, counts=share * self.counts)

    def merge(self, other: "GroupMoments") -> "GroupMoments":
        """Return the sum of both, which have the same layout, where both have moments."""
        others = {each.coordinate: each for each in other.parts}
        parts: list[CoordinateMoments | CoordinateRows] = []
        for one in self.parts:
            two = others.get(one.coordinate)
            if two is None:
                continue
            if isinstance(one, CoordinateRows) and isinstance(two, CoordinateRows):
                both = map(np.concatenate, zip(one.rows, two.rows, strict=True))
                parts.append(CoordinateRows.compact(one.coordinate, list(both)))
                continue
            left, here, there = np.intersect1d(one.left, two.left, return_indices=True)
            moments = one.moments[:, here] + two.moments[:, there]
            parts.append(CoordinateMoments(one.coordinate, left, moments))
        return replace(self, parts=tuple(parts), counts=self.counts + other.counts)

    def restricted(self, layout: RowLayout) -> "GroupMoments":
        """Return the moments for a layout with some of the parameters, the others being zero."""
        places = _places(self.layout, layout)
        parts = (
            part.restricted(np.isin(self.layout.columns[part.coordinate], places))
            for part in self.parts
        )
        return replace(self, layout=layout, parts=tuple(parts))

    def correlation(self, phi: FloatArray, variance: FloatArray) -> FloatArray:
        """Return by how much residuals at φ vary more from group to group than independent ones.

        Parameters
        ----------
        phi : (p,) float64
            Parameters that fit all groups together.
        variance : (n,) float64
            Mean square of the residuals of each coordinate.

        Returns
        -------
        (n,) float64
            At least 1. Mean over columns k of a coordinate's rows of the variance of Σ k e in
            a group, over that of independent residuals e; a coordinate without moments gets the
            mean of the others.
        """
        ratios = np.full(len(self.layout.coordinates), np.nan)
        for part in self.parts:
            i = part.coordinate
            ratios[i] = part.ratio(
                phi[self.layout.columns[i]], self.counts[:, i], float(variance[i])
            )
        known = np.isfinite(ratios)
        ratios = np.maximum(ratios, 1.0)
        return np.where(known, ratios, ratios[known].mean() if known.any() else 1.0)


def _places(layout: RowLayout, some: RowLayout) -> IntArray:
    """Return the indices of a layout's parameters that another layout has too."""
    return np.array([layout.parameters.index(name) for name in some.parameters], dtype=np.intp)
