"""What makes links possible, as a cone program's rows."""

from dataclasses import dataclass

import clarabel  # type: ignore[import-untyped]
import numpy as np
from scipy.linalg import block_diag

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.knowledge import Bounds
from symbid_ros.estimation.quadratic import Quadratic
from symbid_ros.model.inertia import pseudo_inertia

# Least eigenvalue of a link's pseudo-inertia in units of the link's own size. It keeps links
# strictly inside, where the rounding of a written model cannot make them impossible and
# MuJoCo accepts them, yet lies far below what any data can tell.
MARGIN = 1e-7

# A symmetric 4 by 4 matrix as Clarabel's vector: the upper triangle column by column, with
# off-diagonal elements times √2 so that scalar products are kept.
_COLUMN, _ROW = np.tril_indices(4)
_SVEC = np.where(_COLUMN == _ROW, 1.0, np.sqrt(2.0))


@dataclass(frozen=True)
class Constraints:
    """The cone program's rows: matrix x - offset in {0}ᵉ × ℝ₊ᵏ × (4 by 4 semidefinite)ᴸ.

    Pseudo-inertias are scaled from both sides by the link's extent and mass, and every
    bound and link by its own size about the free minimum.
    """

    matrix: FloatArray
    offset: FloatArray
    equations: int
    linear: int
    links: int

    @classmethod
    def about(cls, quadratic: Quadratic, links: int, bounds: Bounds | None) -> "Constraints":
        """Return the constraints on L ``links`` and the bounds, in sizes of the free minimum."""
        scale = quadratic.scale
        count = len(scale)
        cones = np.zeros((10 * links, count))
        inertial = scale[: 10 * links].reshape(-1, 10)
        cones[:, : 10 * links] = block_diag(*map(_scaled_pseudo_inertia, inertial))
        matrix, offset, equations = np.zeros((0, count)), np.zeros(0), 0
        if bounds is not None:
            matrix, offset, equations = bounds.one_sided(count)
        linear = len(matrix)
        matrix = np.concatenate([matrix * scale, cones])
        offset = np.concatenate([offset, np.zeros(10 * links)])
        # A tight or loose prior must neither swamp the solver's tolerances, which are those
        # of the largest row, nor make the margin large beside the link itself.
        deviation = np.linalg.norm(quadratic.in_deviations(matrix), axis=1)
        size = np.maximum(np.abs(matrix @ quadratic.minimum - offset), deviation)
        per_link = size[linear:].reshape(-1, 10).max(axis=1)
        size = np.concatenate([size[:linear], np.repeat(per_link, 10)])
        offset = offset / size
        offset[linear:] += MARGIN * np.tile(_svec(np.eye(4)), links)
        return cls(matrix / size[:, None], offset, equations, linear, links)

    @property
    def cones(self) -> list[object]:
        """The same as Clarabel calls them."""
        return [
            clarabel.ZeroConeT(self.equations),
            clarabel.NonnegativeConeT(self.linear - self.equations),
            *[clarabel.PSDTriangleConeT(4)] * self.links,
        ]

    def slack(self, x: FloatArray) -> FloatArray:
        """Return the vector (m,) that should lie in the cone."""
        return np.asarray(self.matrix @ x - self.offset)

    def outside(self, x: FloatArray) -> FloatArray:
        """Return per bound and link (linear + L,) how far x is outside; inside it is ≤ 0."""
        slack = self.slack(x)
        equations, inequalities = np.split(slack[: self.linear], [self.equations])
        smallest = np.linalg.eigvalsh(_smat(slack[self.linear :]))[:, 0]
        return np.concatenate([np.abs(equations), -inequalities, -smallest])

    def restored(self, x: FloatArray) -> FloatArray:
        """Return x moved just so far that links and one-sided bounds on a parameter hold.

        A link moves along the isotropic body of its scale, the direction that raises all
        eigenvalues of its pseudo-inertia alike.
        """
        x = x.copy()
        for row, offset in zip(
            self.matrix[self.equations : self.linear],
            self.offset[self.equations : self.linear],
            strict=True,
        ):
            at = np.flatnonzero(row)
            if len(at) == 1 and row @ x < offset:
                x[at] = offset / row[at]
        outside = self.outside(x)[self.linear :]
        for link in np.flatnonzero(outside > 0.0):
            own = slice(10 * link, 10 * link + 10)
            raising = np.linalg.solve(self.matrix[self.linear :][own, own], _svec(np.eye(4)))
            x[own] += outside[link] * raising
        return x

    def multipliers(self, z: FloatArray) -> FloatArray:
        """Return the multipliers (m,) of the right sign nearest to z (m,)."""
        values, vectors = np.linalg.eigh(_smat(z[self.linear :]))
        nearest = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2)
        equations, inequalities = np.split(z[: self.linear], [self.equations])
        return np.concatenate([equations, np.maximum(inequalities, 0.0), _svec(nearest).ravel()])


def _scaled_pseudo_inertia(std: FloatArray) -> FloatArray:
    """Return the (10, 10) map from a link's φ / std to its scaled pseudo-inertia's vector.

    The scale is the deviation of the mass, and that of a second moment: half the root of
    the sum of the three moments of inertia's variances, which is the same for each axis.
    """
    moment = 0.5 * np.sqrt(np.sum(std[[4, 7, 9]] ** 2))
    size = 1.0 / np.sqrt([moment, moment, moment, std[0]])
    basis = pseudo_inertia(np.eye(10)) * np.outer(size, size)
    return np.asarray(_svec(basis).T * std)


def _svec(matrix: FloatArray) -> FloatArray:
    return np.asarray(matrix[..., _COLUMN, _ROW] * _SVEC)


def _smat(vector: FloatArray) -> FloatArray:
    vector = vector.reshape(-1, 10) / _SVEC
    matrix = np.empty((len(vector), 4, 4))
    matrix[:, _COLUMN, _ROW] = matrix[:, _ROW, _COLUMN] = vector
    return matrix
