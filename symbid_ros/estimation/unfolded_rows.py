"""Information with a few rows that are not folded in yet.

Folding takes as long for one row as for thirty, and every fold costs the moments of the whole
factor again. A live estimate adds a few rows each second, which count until their block is
complete. With these rows kept beside the factor, moments are the factor's, which are computed once,
plus their own.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.information import ROWS_AT_ONCE, Information


class UnfoldedRows(Information):
    """An information and flat rows (N, w) beside it.

    Parameters
    ----------
    folded : Information
    flat : (N, w) float64
        Finite rows of its layout.
    samples : float
        Effective number of samples of both.
    """

    _folded: Information
    _flat: FloatArray

    def __init__(self, folded: Information, flat: FloatArray, samples: float) -> None:
        self.__dict__.update(layout=folded.layout, samples=samples, _folded=folded, _flat=flat)

    @classmethod
    def added(cls, information: Information, flat: FloatArray) -> Information:
        """Return an information with more flat rows (N, w), unfolded unless they are many."""
        samples, folded = information.samples + len(flat), information
        if isinstance(information, cls):
            if len(information._flat) + len(flat) > ROWS_AT_ONCE:
                return information.fold_flat(flat)
            folded, flat = information._folded, np.concatenate([information._flat, flat])
        if not np.isfinite(flat.sum()):
            return folded.fold_flat(flat)  # which refuses them
        return cls(folded, flat, samples)

    @cached_property
    def _complete(self) -> Information:
        return replace(self._folded.fold_flat(self._flat), samples=self.samples)

    @cached_property
    def factor(self) -> FloatArray:
        """R (r, w) with RᵀR = Σ rowᵀ row."""
        return self._complete.factor

    def fold_flat(self, flat: FloatArray) -> Information:
        """Return the information with more flat rows (N, w), all of them folded."""
        return self._complete.fold_flat(flat)

    def discounted(self, share: float) -> Information:
        """Return the information with every row's weight times ``share``, from 0 to 1."""
        folded, flat = self._folded.discounted(share), np.sqrt(share) * self._flat
        return UnfoldedRows(folded, flat, share * self.samples)

    def column_squares(self, coordinate: int, column: int) -> float:
        """Return Σ K_ij² of coordinate i and parameter j; zero for a structural zero."""
        own = float(np.sum(self._dense[:, coordinate, column] ** 2))
        return self._folded.column_squares(coordinate, column) + own

    @cached_property
    def target_squares(self) -> FloatArray:
        """Σ y² (n,) over all samples."""
        squares: FloatArray = self._folded.target_squares + np.sum(
            self._dense[..., -1] ** 2, axis=0
        )
        return squares

    def whitened_moment(self, precision: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ P [K y] (p + 1, p + 1) for a precision P (n, n) across coordinates."""
        width = self._dense.shape[2]
        weighted = (precision @ self._dense).reshape(-1, width)
        own: FloatArray = self._dense.reshape(-1, width).T @ weighted
        return self._folded.whitened_moment(precision) + own

    def residual_moment(self, phi: FloatArray) -> FloatArray:
        """Return Σ e eᵀ (n, n) over all samples, e = y - K φ, for φ (p,)."""
        residual = self._dense @ np.append(-phi, 1.0)
        moment: FloatArray = self._folded.residual_moment(phi) + residual.T @ residual
        return moment

    def quadratic_moment(self, matrix: FloatArray) -> FloatArray:
        """Return Σ [K y] X [K y]ᵀ (n, n) over all samples for a symmetric X (p + 1, p + 1)."""
        weighted = np.einsum("nip,njp->ij", self._dense @ matrix, self._dense, optimize=True)
        moment: FloatArray = self._folded.quadratic_moment(matrix) + weighted
        return moment

    @cached_property
    def _dense(self) -> FloatArray:
        """[K y] (N, n, p + 1) of the unfolded rows."""
        layout = self.layout
        dense = np.zeros((len(self._flat), len(layout.coordinates), len(layout.parameters) + 1))
        for i, (columns, place) in enumerate(zip(layout.columns, layout.slices, strict=True)):
            dense[:, i, np.append(columns, -1)] = self._flat[:, place]
        return dense
