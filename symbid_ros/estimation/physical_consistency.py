"""Least squares with physically consistent links: a quadratic program with semidefinite cones.

Minimise ½‖W φ - w‖² subject to J(φ_l) ⪰ ε for each link l and to linear bounds, such as the sign
of friction. J is the pseudo-inertia (Wensing, Kim and Slotine 2018, IEEE RA-L 3(1), Eq. 11) in
units of the link's own scale. The problem is convex, and Clarabel (Goulart and Chen 2024,
arXiv:2405.12762) solves it.

The variable is u = R (x - x₀), where x = φ / scale and R is the triangular factor of the scaled
problem about its unconstrained minimum x₀. Then u is in posterior standard deviations, and the
objective ½‖u‖² has the identity as Hessian for data of any condition number. The duality gap
bounds the distance to the optimum, ½‖u - u*‖² ≤ gap, so the solution's accuracy is certified
regardless of the solver's status.

Most constraints hold at the minimum of the violated ones. So the solver gets those first, and the
others when its answer violates them. Its variables are then the directions of u that these move.
"""

from dataclasses import dataclass, replace

import clarabel  # type: ignore[import-untyped]
import numpy as np
from scipy.linalg import block_diag, qr, solve_triangular
from scipy.sparse import csc_array

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.constraints import Bounds
from symbid_ros.model.inertia import pseudo_inertia

# Smallest eigenvalue of a link's pseudo-inertia in units of the link's own size. It keeps links
# strictly consistent despite rounding in a written model, so that MuJoCo accepts them. It is far
# below the resolution of any data.
MARGIN = 1e-7

# Clarabel's vector of a symmetric 4 by 4 matrix: the upper triangle column by column, with
# off-diagonal elements times √2 to preserve scalar products.
_COLUMN, _ROW = np.tril_indices(4)
_SVEC = np.where(_COLUMN == _ROW, 1.0, np.sqrt(2.0))

# Largest certified distance from the optimum, in posterior standard deviations. It is relative if
# the constraints move the solution by more than one.
ACCURACY = 1e-3

_TOLERANCE = 1e-10
_ATTEMPTS: tuple[dict[str, object], ...] = (
    # The problem is scaled already; a second scaling costs two digits of the gap.
    {"equilibrate_enable": False},
    {"equilibrate_enable": True},
    {"equilibrate_enable": False, "max_step_fraction": 0.9, "iterative_refinement_max_iter": 50},
)
_INFEASIBLE = {"PrimalInfeasible", "AlmostPrimalInfeasible"}
# Statuses that further constraints do not change.
_GIVEN_UP = _INFEASIBLE | {"MaxIterations"}


@dataclass(frozen=True)
class Quadratic:
    """‖factor φ - target‖² as ‖R (x - x₀)‖² + c, with x = φ / scale.

    Attributes
    ----------
    scale : (p,) float64
        Units of the parameters.
    triangle : (p, p) float64
        Upper triangular R.
    minimum : (p,) float64
        Unconstrained minimum x₀.
    """

    scale: FloatArray
    triangle: FloatArray
    minimum: FloatArray

    @classmethod
    def of(cls, factor: FloatArray, target: FloatArray, scale: FloatArray) -> "Quadratic":
        """Return ‖factor φ - target‖² (r rows) in units of ``scale`` (p,).

        Raises
        ------
        EstimateError
            When a number is not finite, or the rows do not determine φ.
        """
        if not (np.all(np.isfinite(factor)) and np.all(np.isfinite(target))):
            raise EstimateError(
                "a row of data or prior is not finite; mask the sample it came from", "E413"
            )
        if not np.all((scale > 0) & np.isfinite(scale)):
            raise EstimateError(
                "a prior standard deviation is not a positive number; correct the prior", "E404"
            )
        count = len(scale)
        rows = np.column_stack([factor * scale, target])
        triangle = np.asarray(qr(rows, mode="r", overwrite_a=True)[0], dtype=np.float64)
        R, projected = triangle[:count, :count], triangle[:count, count]
        pivots = np.abs(np.diag(R))
        if len(R) < count or pivots.min() <= count * np.finfo(float).eps * pivots.max():
            raise EstimateError(
                "data and prior together do not determine all parameters; give each a prior "
                "standard deviation in proportion to the others",
                "E418",
            )
        return cls(scale, R, np.asarray(solve_triangular(R, projected)))

    def in_deviations(self, matrix: FloatArray) -> FloatArray:
        """Return matrix R⁻¹ (m, p), which converts rows on x to rows on u."""
        return np.asarray(solve_triangular(self.triangle, matrix.T, trans="T").T)

    def point(self, u: FloatArray) -> FloatArray:
        """Return x (p,) at u (p,) posterior deviations from the minimum."""
        return np.asarray(self.minimum + solve_triangular(self.triangle, u))

    def deviations(self, x: FloatArray) -> FloatArray:
        """Return u (p,), the posterior deviations of x (p,) from the minimum."""
        return np.asarray(self.triangle @ (x - self.minimum))


@dataclass(frozen=True)
class ConicConstraints:
    """Cone constraints: matrix x - offset in {0}ᵉ × ℝ₊ᵏ × (4 by 4 semidefinite)ᴸ.

    Pseudo-inertias are scaled from both sides by the link's extent and mass. Every bound and link
    is scaled by its own size at the unconstrained minimum.
    """

    matrix: FloatArray
    offset: FloatArray
    equations: int
    linear: int
    links: int

    @classmethod
    def about(cls, quadratic: Quadratic, links: int, bounds: Bounds | None) -> "ConicConstraints":
        """Return the constraints on L ``links`` and the bounds, scaled at the free minimum."""
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
        # The solver's tolerances are relative to the largest row, and the margin to the link.
        # Neither may depend on how wide the prior is.
        deviation = np.linalg.norm(quadratic.in_deviations(matrix), axis=1)
        size = np.maximum(np.abs(matrix @ quadratic.minimum - offset), deviation)
        per_link = size[linear:].reshape(-1, 10).max(axis=1)
        size = np.concatenate([size[:linear], np.repeat(per_link, 10)])
        offset = offset / size
        offset[linear:] += MARGIN * np.tile(_svec(np.eye(4)), links)
        return cls(matrix / size[:, None], offset, equations, linear, links)

    def some(self, chosen: BoolArray) -> "ConicConstraints":
        """Return the chosen (linear + L,) bounds and links, all equations among them."""
        rows = self.rows(chosen)
        linear = int(np.count_nonzero(chosen[: self.linear]))
        links = int(np.count_nonzero(chosen[self.linear :]))
        return ConicConstraints(self.matrix[rows], self.offset[rows], self.equations, linear, links)

    def rows(self, chosen: BoolArray) -> BoolArray:
        """Return which rows (m,) belong to the chosen (linear + L,) bounds and links."""
        return np.concatenate([chosen[: self.linear], np.repeat(chosen[self.linear :], 10)])

    @property
    def cones(self) -> list[object]:
        """The cones as Clarabel objects."""
        return [
            clarabel.ZeroConeT(self.equations),
            clarabel.NonnegativeConeT(self.linear - self.equations),
            *[clarabel.PSDTriangleConeT(4)] * self.links,
        ]

    def slack(self, x: FloatArray) -> FloatArray:
        """Return the vector (m,) that must lie in the cone."""
        return np.asarray(self.matrix @ x - self.offset)

    def outside(self, x: FloatArray) -> FloatArray:
        """Return per bound and link (linear + L,) how far x is outside; ≤ 0 means inside."""
        slack = self.slack(x)
        equations, inequalities = np.split(slack[: self.linear], [self.equations])
        smallest = np.linalg.eigvalsh(_smat(slack[self.linear :]))[:, 0]
        return np.concatenate([np.abs(equations), -inequalities, -smallest])

    def restored(self, x: FloatArray) -> FloatArray:
        """Return x moved just enough to satisfy links and one-sided bounds on a parameter.

        A link moves along the isotropic body of its scale, which raises all eigenvalues of its
        pseudo-inertia equally.
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
        """Return the dual feasible multipliers (m,) nearest to z (m,)."""
        values, vectors = np.linalg.eigh(_smat(z[self.linear :]))
        nearest = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2)
        equations, inequalities = np.split(z[: self.linear], [self.equations])
        return np.concatenate([equations, np.maximum(inequalities, 0.0), _svec(nearest).ravel()])


def _scaled_pseudo_inertia(std: FloatArray) -> FloatArray:
    """Return the (10, 10) map from a link's φ / std to its scaled pseudo-inertia's vector.

    The scale is the deviation of the mass and that of a second moment. The latter is the same for
    each axis: half the root of the sum of the three moments of inertia's variances.
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


@dataclass(frozen=True)
class ConsistentSolution:
    """The least-squares minimum among physically consistent parameters.

    Attributes
    ----------
    value : (p,) float64
        Parameters, in SI units.
    smallest : (L,) float64
        Per link the smallest eigenvalue of its pseudo-inertia, in units of the link's size at the
        free minimum or of its posterior deviation, whichever is larger. It is at least
        :data:`MARGIN`, except for rounding.
    active : (L,) bool
        Whether the link's constraint is active.
    moved : float
        Distance from the unconstrained minimum in posterior standard deviations.
    accuracy : float
        Upper bound on the distance from the exact minimum, in the same units.
    status : str
        ``Free`` if no constraint is active, else the solver's status.
    iterations : int
        Interior-point iterations of all attempts.
    """

    value: FloatArray
    smallest: FloatArray
    active: BoolArray
    moved: float
    accuracy: float
    status: str
    iterations: int


def consistent_minimum(
    factor: FloatArray,
    target: FloatArray,
    scale: FloatArray,
    links: int,
    bounds: Bounds | None = None,
) -> ConsistentSolution:
    """Minimise ‖factor φ - target‖² subject to physically consistent links and bounds.

    Parameters
    ----------
    factor : (r, p) float64
        Whitened rows of data and prior, with full column rank.
    target : (r,) float64
        Right-hand sides of the rows.
    scale : (p,) float64
        Standard deviations of the prior, in SI units.
    links : int
        Number of links. Their ten parameters each are the first columns.
    bounds : Bounds, optional
        Linear bounds on the parameters.

    Returns
    -------
    ConsistentSolution
        The minimum, and a bound on its distance from the exact one.

    Raises
    ------
    EstimateError
        When the rows do not determine the parameters, no consistent links satisfy the bounds, or
        the solver does not reach :data:`ACCURACY`.
    """
    quadratic = Quadratic.of(factor, target, scale)
    constraints = ConicConstraints.about(quadratic, links, bounds)
    if np.all(constraints.outside(quadratic.minimum) <= 0.0):
        return _solution(quadratic, constraints, quadratic.minimum, 0.0)
    statuses: list[str] = []
    iterations = 0
    for options in _ATTEMPTS:
        solution = _attempt(quadratic, constraints, options)
        statuses.append(solution.status)
        iterations += solution.iterations
        if solution.accuracy <= ACCURACY * max(1.0, solution.moved):
            return replace(solution, iterations=iterations)
    if bounds is not None and _INFEASIBLE & set(statuses):
        shown = ", ".join(bounds.names[:4]) + (" ..." if len(bounds.names) > 4 else "")
        raise EstimateError(
            f"no physically consistent links satisfy the bounds on {shown}; loosen one of them",
            "E416",
        )
    raise EstimateError(
        f"the physically consistent minimum was not found to {ACCURACY:g} standard deviations "
        f"(solver: {', '.join(dict.fromkeys(statuses))}); correct the prior std that is out "
        "of proportion to the others",
        "E417",
    )


def _attempt(
    quadratic: Quadratic, constraints: ConicConstraints, options: dict[str, object]
) -> ConsistentSolution:
    """Run Clarabel, move its solution inside the constraints and bound its error."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
    for option, value in options.items():
        setattr(settings, option, value)
    # A u + s = b with s in the cone, in units of the smallest distance to the cone.
    A = -quadratic.in_deviations(constraints.matrix)
    count, linear = len(quadratic.minimum), constraints.linear
    per_link = A[linear:].reshape(constraints.links, 10 * count)
    pull = np.concatenate([np.linalg.norm(rows, axis=1) for rows in (A[:linear], per_link)])
    way = max(1.0, float(np.max(constraints.outside(quadratic.minimum) / pull)))
    x, accuracy, iterations = quadratic.minimum, np.inf, 0
    chosen = constraints.outside(x) > 0.0
    chosen[: constraints.equations] = True
    while True:
        some, rows = constraints.some(chosen), constraints.rows(chosen)
        # u is a combination of the gradients of these constraints, which Q spans.
        Q, R = np.linalg.qr(A[rows].T)
        answer = clarabel.DefaultSolver(
            csc_array(np.eye(Q.shape[1])),
            np.zeros(Q.shape[1]),
            csc_array(R.T),
            some.slack(quadratic.minimum) / way,
            some.cones,
            settings,
        ).solve()
        iterations += int(answer.iterations)
        u, z = way * (Q @ np.array(answer.x)), np.zeros(len(A))
        z[rows] = way * np.array(answer.z)
        status, is_finite = str(answer.status), bool(np.all(np.isfinite(np.append(u, z))))
        if status in _GIVEN_UP or not is_finite:
            break
        violated = constraints.outside(quadratic.point(u)) > 0.0
        if not np.any(violated & ~chosen):
            break
        chosen |= violated
    if is_finite:
        x = constraints.restored(quadratic.point(u))
        if np.all(constraints.outside(x) <= MARGIN / 2):
            z = constraints.multipliers(z)
            stationarity = quadratic.deviations(x) + A.T @ z
            gap = 0.5 * stationarity @ stationarity + abs(constraints.slack(x) @ z)
            accuracy = float(np.sqrt(2.0 * gap))
    return _solution(quadratic, constraints, x, accuracy, status=status, iterations=iterations)


def _solution(
    quadratic: Quadratic,
    constraints: ConicConstraints,
    x: FloatArray,
    accuracy: float,
    *,
    status: str = "Free",
    iterations: int = 0,
) -> ConsistentSolution:
    smallest = MARGIN - constraints.outside(x)[constraints.linear :]
    return ConsistentSolution(
        value=x * quadratic.scale,
        smallest=smallest,
        active=smallest < 10 * MARGIN,
        moved=float(np.linalg.norm(quadratic.deviations(x))),
        accuracy=accuracy,
        status=status,
        iterations=iterations,
    )
