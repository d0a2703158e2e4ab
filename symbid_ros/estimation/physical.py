"""The least-squares minimum among physically possible links: a quadratic under cones.

Minimise ½‖W φ - w‖² subject to J(φ_l) ⪰ ε for each link l, where J is the pseudo-inertia
(Wensing, Kim and Slotine 2018, IEEE RA-L 3(1), Eq. 11) in units of the link's own scale,
and to linear bounds, such as the sign of friction. The problem is convex, and Clarabel
(Goulart and Chen 2024, arXiv:2405.12762) solves it.

Clarabel is given u = R (x - x₀), with x = φ / scale and R the triangular factor of the
scaled problem about its free minimum x₀: the objective is then ½‖u‖², whose Hessian is the
identity whatever the data's condition, and u counts posterior standard deviations. It also
makes the duality gap bound the distance to the optimum, ½‖u - u*‖² ≤ gap, so that an
answer is judged by what it is and not by the status it came with.
"""

from dataclasses import dataclass, replace

import clarabel  # type: ignore[import-untyped]
import numpy as np
from scipy.sparse import csc_array

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.cones import MARGIN, Constraints
from symbid_ros.estimation.knowledge import Bounds
from symbid_ros.estimation.quadratic import Quadratic

# Largest certified distance from the optimum: in posterior standard deviations, or relative
# to the way from the free minimum where the constraints move the answer by more than one.
ACCURACY = 1e-3

_TOLERANCE = 1e-10
_ATTEMPTS: tuple[dict[str, object], ...] = (
    # The problem comes scaled; a second scaling costs two digits of the gap.
    {"equilibrate_enable": False},
    {"equilibrate_enable": True},
    {"equilibrate_enable": False, "max_step_fraction": 0.9, "iterative_refinement_max_iter": 50},
)
_INFEASIBLE = {"PrimalInfeasible", "AlmostPrimalInfeasible"}


@dataclass(frozen=True)
class ConsistentSolution:
    """The minimum among physically possible links.

    Attributes
    ----------
    value : (p,) float64
        Parameters, in SI units.
    smallest : (L,) float64
        Per link the least eigenvalue of its pseudo-inertia in units of its own size (of
        the free minimum or of its posterior deviation, whichever is larger); at least
        :data:`MARGIN`, but for rounding.
    active : (L,) bool
        Whether the link lies on the border of what is possible.
    moved : float
        Distance from the free minimum in posterior standard deviations.
    accuracy : float
        Upper bound on the distance from the exact minimum, in the same units.
    status : str
        ``Free`` when no constraint matters, else the solver's own word.
    iterations : int
        Interior-point iterations, of all attempts.
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
    """Minimise ‖factor φ - target‖² among physically possible links.

    Parameters
    ----------
    factor : (r, p) float64
        Whitened rows of data and prior, of full column rank.
    target : (r,) float64
        Their right-hand sides.
    scale : (p,) float64
        The prior's standard deviations, in SI units.
    links : int
        Number of links, whose ten parameters each come first.
    bounds : Bounds, optional
        Linear bounds on the parameters.

    Returns
    -------
    ConsistentSolution
        The minimum, and a bound on its distance from the exact one.

    Raises
    ------
    EstimateError
        When the rows do not determine the parameters, no possible links meet the
        bounds, or the solver does not come within :data:`ACCURACY` of the optimum.
    """
    quadratic = Quadratic.of(factor, target, scale)
    constraints = Constraints.about(quadratic, links, bounds)
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
            f"no physically possible links meet the bounds on {shown}; loosen one of them"
        )
    raise EstimateError(
        f"the physically possible minimum was not found to {ACCURACY:g} standard deviations "
        f"(solver: {', '.join(dict.fromkeys(statuses))}); look for a prior deviation out of all "
        "proportion to the others"
    )


def _attempt(
    quadratic: Quadratic, constraints: Constraints, options: dict[str, object]
) -> ConsistentSolution:
    """Run Clarabel, put its answer inside the constraints and bound its error."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
    for option, value in options.items():
        setattr(settings, option, value)
    # A u + s = b with s in the cone, and lengths in units of the least way to the cone.
    A = -quadratic.in_deviations(constraints.matrix)
    count, linear = len(quadratic.minimum), constraints.linear
    per_link = A[linear:].reshape(constraints.links, 10 * count)
    pull = np.concatenate([np.linalg.norm(rows, axis=1) for rows in (A[:linear], per_link)])
    way = max(1.0, float(np.max(constraints.outside(quadratic.minimum) / pull)))
    answer = clarabel.DefaultSolver(
        csc_array(np.eye(count)),
        np.zeros(count),
        csc_array(A),
        constraints.slack(quadratic.minimum) / way,
        constraints.cones,
        settings,
    ).solve()
    x, accuracy = quadratic.minimum, np.inf
    u, z = way * np.array(answer.x), way * np.array(answer.z)
    if np.all(np.isfinite(u)) and np.all(np.isfinite(z)):
        x = constraints.restored(quadratic.point(u))
        if np.all(constraints.outside(x) <= MARGIN / 2):
            z = constraints.multipliers(z)
            stationarity = quadratic.deviations(x) + A.T @ z
            gap = 0.5 * stationarity @ stationarity + abs(constraints.slack(x) @ z)
            accuracy = float(np.sqrt(2.0 * gap))
    status, iterations = str(answer.status), int(answer.iterations)
    return _solution(quadratic, constraints, x, accuracy, status=status, iterations=iterations)


def _solution(
    quadratic: Quadratic,
    constraints: Constraints,
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
