"""Design of a trajectory: sequential quadratic programs over Fourier coefficients.

Limits of positions, velocities and accelerations are linear in the coefficients, so that each
program keeps them exactly, at all samples. Efforts and distances are linearized within a trust
region, and every step keeps them, so that the search can stop at any time. Clarabel, a dependency
of the package, solves a program in some ten milliseconds. SciPy's SLSQP, with one smooth maximum
for each limit, left the feasible set near obstacles and did not return; IPOPT through CasADi would
add 93 MB and a second formulation of the dynamics.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import clarabel  # type: ignore[import-untyped]
import numpy as np
from scipy.optimize import brentq
from scipy.sparse import csc_array, eye_array, kron, vstack

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import OptionError
from symbid_ros.excitation.clearance import Clearance
from symbid_ros.excitation.fourier import FourierSeries
from symbid_ros.excitation.limits import JointLimits
from symbid_ros.excitation.objective import Evaluation, ExpectedInformation

CONVERGED = 0.02  # expected gain of a program, nat
# Trust region: largest change of a coefficient, rad or m.
FIRST_STEP, LARGEST_STEP, SMALLEST_STEP = 0.2, 1.0, 1e-4
GROWTH, SHRINKAGE = 1.6, 0.4
LEAST_SHARE = 0.1  # of the predicted gain that a step must reach
FIRST_CURVATURE = 1.0  # nat per squared coefficient
DAMPING = 0.2
AIM = 0.97  # share of nonlinear limits that a program aims at; steps may use all
NEAR = 0.5  # share of a nonlinear limit from which it is linearized
# A trajectory is checked at more instants than the search uses. Legs that follow a base move faster
# than its harmonics, so their peaks are short. Distances take much longer to compute, and peak
# where joints are slow.
REFINEMENT, DISTANCE_REFINEMENT = 16, 4
# Largest share of a limit at the checked instants: a peak between them is less than a thousandth
# higher.
LARGEST_SHARE = 0.999
SCALE_TOLERANCE = 2e-4  # of the factor by which a trajectory is scaled into the limits
KEEP_EVERY = 10  # iterations; to check a trajectory between samples takes as long as some of them
CANDIDATES = 4  # random trajectories drawn for each start; the best become starts
RETRIES = 40  # random starts that are tried for a feasible one


@dataclass(frozen=True)
class Design:
    """What a trajectory is optimised for.

    Attributes
    ----------
    series : FourierSeries
    expected : ExpectedInformation
    limits : JointLimits
        Of the D coordinates: positions, velocities and accelerations.
    clearance : Clearance or None
        Distances to keep; None if nothing has a shape.
    samples : int
        Number N of instants of a period at which gain and limits are computed.
    rows_per_second : float
        Independent rows of each coordinate.
    seconds : float
        Length of the recording.
    """

    series: FourierSeries
    expected: ExpectedInformation
    limits: JointLimits
    clearance: Clearance | None
    samples: int
    rows_per_second: float
    seconds: float

    @property
    def time(self) -> FloatArray:
        """(N,) instants of one period, s."""
        return self.instants(self.samples)

    def instants(self, count: int) -> FloatArray:
        """Return equidistant instants (count,) of one period, s."""
        return np.asarray(np.arange(count) * (self.series.period / count), dtype=np.float64)

    @property
    def repeats(self) -> float:
        """Number of independent rows for which one sample stands."""
        return self.rows_per_second * self.seconds / self.samples

    def gain(self, coefficients: FloatArray) -> float:
        """Return the expected gain of information for coefficients (m, D), nat."""
        motion = self.series.motion(coefficients, self.time)
        rows = self.expected.measured_rows(motion)
        return self.expected.gain(self.repeats * self.expected.information(rows))

    def excess(self, coefficients: FloatArray, count: int | None = None) -> float:
        """Return the largest share of any limit that is used; at most 1 is feasible.

        Parameters
        ----------
        coefficients : (m, D) float64
        count : int, optional
            Number of instants of the period, by default those of the search. Distances count at
            `DISTANCE_REFINEMENT` times as many as the search uses, at most.
        """
        count = self.samples if count is None else count
        motion = self.series.motion(coefficients, self.instants(count))
        used = max(float(each.max()) for each in self.limits.usage(motion).values())
        if used <= 1.0:
            used = max(used, float(np.abs(self.expected.shares(motion)).max(initial=0.0)))
        if used > 1.0 or self.clearance is None:  # distances take much longer
            return used
        stride = max(1, count // (DISTANCE_REFINEMENT * self.samples))
        position = self.expected.joints.samples(motion[:, ::stride]).position
        return max(used, self.clearance.usage(position))

    def obstacle(self, coordinates: FloatArray) -> tuple[float, str]:
        """Return the largest share of a limit at rest at coordinates (D,), and what it is of."""
        motion = np.zeros((3, 1, len(coordinates)))
        motion[0] = coordinates
        joints = self.expected.joints
        found = [
            (float(one), f"the position of {name}")
            for one, name in zip(
                self.limits.usage(motion)["position"], joints.coordinates, strict=True
            )
        ]
        shares = np.abs(self.expected.shares(motion))[0]
        found += zip(shares.tolist(), joints.share_names(len(shares)), strict=True)
        used, name = max(found)
        worst = used, f"{name} uses {100 * used:.0f} % of what is allowed"
        if used <= 1.0 and self.clearance is not None:
            position = joints.samples(motion).position
            distance, links = self.clearance.smallest(position)
            gap = f"{1e3 * abs(distance):.2g} mm"
            text = f"{links} {f'are {gap} apart' if distance > 0 else f'overlap by {gap}'}"
            worst = max(worst, (self.clearance.usage(position), text))
        return worst


@dataclass(frozen=True)
class Progress:
    """State of an optimisation.

    Attributes
    ----------
    start, starts : int
        Number of the start, from 1, and number of starts; 0 while random trajectories are drawn.
    iteration : int
        Iterations since that start.
    gain : float
        Expected gain of the best feasible trajectory so far, nat.
    """

    start: int
    starts: int
    iteration: int
    gain: float


class TrajectoryOptimizer:
    """Finds the coefficients with the largest expected gain within the limits.

    ``best`` always holds the best feasible coefficients so far, so that an interrupted search has
    a result, and ``random`` the best random ones.

    Parameters
    ----------
    design : Design
    seed : int
        Seed of the random starts.
    report : callable, optional
        Called with a `Progress` after each iteration.
    """

    def __init__(
        self, design: Design, seed: int, report: Callable[[Progress], None] | None = None
    ) -> None:
        self.design = design
        self._random = np.random.default_rng(seed)
        self._report = report
        self.best: FloatArray | None = None
        self.random: FloatArray | None = None
        self.best_gain = -np.inf
        self._basis = design.series.basis(design.time)
        self._shape = (design.series.size, len(design.limits.names))
        self._size = design.series.size * len(design.limits.names)

    def draw(self) -> FloatArray | None:
        """Return random coefficients that touch a limit; None if none of many are feasible."""
        for _ in range(RETRIES):
            coefficients = self._draw()
            scale = self._largest_scale(coefficients)
            if scale > 0:
                return self._shrunk(coefficients, scale)
        about = self._at_rest()[0]
        scale = self._largest_scale(coefficients, largest=1.0, about=about)
        return self._shrunk(coefficients, scale, about) if scale > 0 else None

    def run(self, starts: int, iterations: int) -> FloatArray:
        """Optimise from several starts and return the best coefficients (m, D).

        Parameters
        ----------
        starts, iterations : int
            Number of starts, and of iterations of each.

        Raises
        ------
        OptionError
            When no random trajectory keeps the limits.
        """
        candidates: list[FloatArray] = []
        for _ in range(CANDIDATES * starts):
            drawn = self.draw()
            if drawn is not None:
                candidates.append(drawn)
                candidates.sort(key=self.design.gain, reverse=True)
                self.random = candidates[0]
                self._keep(drawn)
            self._tell(0, starts, 0)
        if not candidates:
            self.random = self._at_rest()
            candidates.append(self.random)
            self._keep(self.random)
        if self.best is None:
            raise OptionError(
                f"{self.design.expected.joints.model.source}: no random motion keeps the limits "
                f"and distances: in the best of {RETRIES} random postures, {self._obstacle()}; "
                "check the collision shapes and limits, or give a lower `floor`, a smaller "
                "`clearance` or `no_collision`; of a standing robot another `posture`",
                "E584",
            )
        for number, start in enumerate(candidates[:starts], start=1):
            self._climb(start, number, starts, iterations)
        return self.best

    def _obstacle(self) -> str:
        """Return what prevents the robot from resting in the best of some random postures."""
        drawn = [self._at_rest()[0], *(self._draw()[0] for _ in range(RETRIES - 1))]
        return min(self.design.obstacle(coordinates) for coordinates in drawn)[1]

    def _climb(self, start: FloatArray, number: int, starts: int, iterations: int) -> None:
        """Improve a feasible start by quadratic programs within a trust region."""
        point, step = start.ravel(), FIRST_STEP
        here = self._linearized(point)
        curvature = FIRST_CURVATURE * np.eye(len(point))
        for count in range(1, iterations + 1):
            move = best_move(here, curvature, step)
            bent = curvature @ move
            predicted = here.slope @ move - move @ bent / 2
            if predicted < CONVERGED:
                break
            gain = self.design.gain((point + move).reshape(self._shape))
            if gain > here.gain + LEAST_SHARE * predicted and self._fits(point + move):
                point = point + move
                there = self._linearized(point)
                curvature = updated_curvature(curvature, move, here.slope - there.slope)
                here, step = there, min(GROWTH * step, LARGEST_STEP)
            else:
                step = SHRINKAGE * float(np.abs(move).max())
                if step < SMALLEST_STEP:
                    break
            if count % KEEP_EVERY == 0:
                self._keep(point.reshape(self._shape))
            self._tell(number, starts, count)
        self._keep(point.reshape(self._shape))

    def _tell(self, start: int, starts: int, iteration: int) -> None:
        if self._report is not None:
            self._report(Progress(start, starts, iteration, self.best_gain))

    def _fits(self, point: FloatArray) -> bool:
        return self.design.excess(point.reshape(self._shape)) <= 1.0

    def _linearized(self, point: FloatArray) -> "LinearizedProblem":
        """Return gain and limits about a point (x,), to first order."""
        motion = self._basis @ point.reshape(self._shape)
        evaluation = self.design.expected.evaluate(motion, self.design.repeats)
        slope = np.einsum("otm,otd->md", self._basis, evaluation.gain_slopes).ravel()
        blocks = [*self._motion_limits(motion), *self._other_limits(evaluation)]
        if self.design.clearance is not None:
            blocks += self._clearances(motion)
        rows, room = zip(*blocks, strict=True)
        return LinearizedProblem(evaluation.gain, slope, vstack(rows, "csc"), np.concatenate(room))

    def _motion_limits(self, motion: FloatArray) -> Iterator[tuple[csc_array, FloatArray]]:
        """Yield rows and room of the limits of position, velocity and acceleration."""
        limits = self.design.limits
        scales = (limits.half_width, limits.speed, limits.acceleration)
        for order, scale in enumerate(scales):
            share = (motion[order] - (limits.centre if order == 0 else 0.0)) / scale
            rows = csc_array(kron(self._basis[order], np.diag(1 / scale)))
            yield rows, 1.0 - share.ravel()
            yield -rows, 1.0 + share.ravel()

    def _other_limits(self, evaluation: Evaluation) -> Iterator[tuple[csc_array, FloatArray]]:
        """Yield rows and room of limits of efforts and contacts, where they are near."""
        for index, share in enumerate(evaluation.shares.T):
            near = np.flatnonzero(np.abs(share) > NEAR)
            sign = np.sign(share[near])
            slopes = evaluation.share_slopes[:, near, index]
            rows = np.einsum("otm,t,otd->tmd", self._basis[:, near], sign, slopes)
            yield csc_array(rows.reshape(len(near), self._size)), AIM - np.abs(share[near])

    def _clearances(self, motion: FloatArray) -> Iterator[tuple[csc_array, FloatArray]]:
        """Yield rows and room of the distances between links, where they are small."""
        assert self.design.clearance is not None
        joints = self.design.expected.joints
        by_coordinate = joints.slopes(motion)
        for share, slopes in self.design.clearance.shares(joints.samples(motion).position):
            near = np.flatnonzero(share > 0)
            moved = np.einsum("tj,tjd->td", slopes[near], by_coordinate[near])
            rows = np.einsum("tm,td->tmd", self._basis[0, near], moved)
            yield csc_array(rows.reshape(len(near), self._size)), AIM - share[near]

    def _keep(self, coefficients: FloatArray) -> None:
        """Store coefficients, shrunk into the limits if needed, if they are the best so far."""
        if not np.all(np.isfinite(coefficients)) or self.design.gain(coefficients) < self.best_gain:
            return
        scale, about = self._largest_scale(coefficients, largest=1.0), None
        if scale <= 0:  # a standing robot may be unable to rest in the middle of its motion
            about = self._at_rest()[0]
            scale = self._largest_scale(coefficients, largest=1.0, about=about)
        if scale <= 0:
            return
        feasible = self._shrunk(coefficients, scale, about)
        gain = self.design.gain(feasible)
        if gain > self.best_gain:
            self.best, self.best_gain = feasible, gain

    def _largest_scale(
        self, coefficients: FloatArray, largest: float = 8.0, about: FloatArray | None = None
    ) -> float:
        """Return the largest factor of `_shrunk` within all limits, 0 if rest is not."""
        count = REFINEMENT * self.design.samples
        tried: dict[float, float] = {}

        def over(scale: float) -> float:
            shrunk = self._shrunk(coefficients, scale, about)
            used = self.design.excess(shrunk, count if scale > 0 else 1)
            tried[scale] = used - LARGEST_SHARE if np.isfinite(used) else LARGEST_SHARE
            return tried[scale]

        if over(0.0) > 0.0:
            return 0.0
        if over(largest) > 0.0:
            brentq(over, 0.0, largest, xtol=SCALE_TOLERANCE)
        return max(scale for scale, excess in tried.items() if excess <= 0.0)

    @staticmethod
    def _shrunk(
        coefficients: FloatArray, scale: float, about: FloatArray | None = None
    ) -> FloatArray:
        """Return the motion with smaller waves, about its own middle or coordinates (D,)."""
        scaled = scale * coefficients
        scaled[0] = coefficients[0] if about is None else about + scale * (coefficients[0] - about)
        return scaled

    def _draw(self) -> FloatArray:
        limits, series = self.design.limits, self.design.series
        coefficients = self._random.normal(size=self._shape)
        waves = np.abs(series.motion(coefficients, self.design.time))
        # Equal shares of position and speed limits.
        largest = np.maximum(
            waves[0].max(axis=0) / limits.half_width, waves[1].max(axis=0) / limits.speed
        )
        coefficients *= self._random.uniform(0.3, 0.9, self._shape[1]) / largest
        coefficients[0] = limits.centre + limits.half_width * self._random.uniform(
            -0.5, 0.5, self._shape[1]
        )
        return coefficients

    def _at_rest(self) -> FloatArray:
        coefficients = np.zeros(self._shape)
        coefficients[0] = self.design.expected.joints.rest
        return coefficients


@dataclass(frozen=True)
class LinearizedProblem:
    """Gain and limits about coefficients (x,), to first order in their change d.

    Attributes
    ----------
    gain : float
        Nat.
    slope : (x,) float64
        Derivative of the gain.
    rows : (k, x) csc_array
        The limits are rows @ d ≤ room.
    room : (k,) float64
        Shares of the limits that are left.
    """

    gain: float
    slope: FloatArray
    rows: csc_array
    room: FloatArray


def best_move(problem: LinearizedProblem, curvature: FloatArray, step: float) -> FloatArray:
    """Return the change d (x,) that maximises slopeᵀd - dᵀ curvature d / 2 within the limits.

    No coefficient changes by more than ``step``.
    """
    size = len(problem.slope)
    unit = eye_array(size, format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    rows = vstack([problem.rows, unit, -unit], "csc")
    own = problem.room
    for smallest in (-np.inf, 0.0):  # if the excess cannot be undone within the step, keep it
        room = np.concatenate([np.maximum(own, smallest), np.full(2 * size, step)])
        answer = clarabel.DefaultSolver(
            csc_array(np.triu(curvature)),
            -problem.slope,
            rows,
            room,
            [clarabel.NonnegativeConeT(len(room))],
            settings,
        ).solve()
        if str(answer.status) in ("Solved", "AlmostSolved"):
            return np.asarray(answer.x, dtype=np.float64)
    return np.zeros(size)


def updated_curvature(curvature: FloatArray, move: FloatArray, change: FloatArray) -> FloatArray:
    """Return the curvature (x, x) after the loss's slope changed by (x,) along a move (x,).

    Damped BFGS keeps it positive definite (Nocedal and Wright 2006, Numerical Optimization,
    procedure 18.2).
    """
    bent = curvature @ move
    along, expected = float(move @ change), float(move @ bent)
    if along < DAMPING * expected:
        share = (1 - DAMPING) * expected / (expected - along)
        change = share * change + (1 - share) * bent
        along = float(move @ change)
    updated: FloatArray = (
        curvature - np.outer(bent, bent) / expected + np.outer(change, change) / along
    )
    return updated
