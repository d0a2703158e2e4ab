"""Design of a trajectory: SLSQP over Fourier coefficients, from several random starts.

SLSQP of SciPy, a dependency of the package, suits the problem: about a hundred variables, a few
dozen smooth constraints, exact gradients. IPOPT through CasADi would add 93 MB and a second
formulation of the dynamics. One smooth maximum over all
samples bounds each limit of each joint (Kreisselmeier and Steinhauser 1979), so that the number of
constraints does not grow with the number of samples.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from symbid_ros.arrays import FloatArray
from symbid_ros.excitation.fourier import FourierSeries
from symbid_ros.excitation.limits import JointLimits
from symbid_ros.excitation.objective import Evaluation, ExpectedInformation

# The smooth maximum exceeds the maximum by at most log(2 N) / SHARPNESS: 2 % for 150 samples.
SHARPNESS = 250.0
CONVERGED = 1e-3  # nat
KEEP_EVERY = 10  # iterations; to check a trajectory between samples takes as long as one of them
RETRIES = 40  # random starts that are tried for a feasible one


@dataclass(frozen=True)
class Design:
    """What a trajectory is optimised for.

    Attributes
    ----------
    series : FourierSeries
    expected : ExpectedInformation
    limits : JointLimits
        Of the D joints that move.
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
        rows = self.expected.rows(motion)
        return self.expected.gain(self.repeats * self.expected.information(rows))

    def excess(self, coefficients: FloatArray, time: FloatArray | None = None) -> float:
        """Return the largest share of any limit that is used; at most 1 is feasible."""
        motion = self.series.motion(coefficients, self.time if time is None else time)
        torque = self.expected.rows(motion) @ self.expected.values
        driven = torque[:, list(self.expected.joints.indices)]
        used = [float(each.max()) for each in self.limits.usage(motion, driven).values()]
        return max(used)


@dataclass(frozen=True)
class Progress:
    """State of an optimisation.

    Attributes
    ----------
    start, starts : int
        Number of the start, from 1, and number of starts.
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
    a result.

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
        self.best_gain = -np.inf
        self._basis = design.series.basis(design.time)
        self._shape = (design.series.size, len(design.limits.names))
        self._cached: tuple[bytes, Evaluation, FloatArray, FloatArray] | None = None

    def draw(self) -> FloatArray | None:
        """Return random coefficients that touch a limit; None if none of many are feasible."""
        for _ in range(RETRIES):
            coefficients = self._draw()
            scale = self._largest_scale(coefficients)
            if scale > 0:
                return self._shrunk(coefficients, scale)
        return None

    def run(self, starts: int, iterations: int) -> FloatArray:
        """Optimise from several starts and return the best coefficients (m, D).

        Parameters
        ----------
        starts, iterations : int
            Number of starts, and of iterations of each.
        """
        candidates = [each for _ in range(3 * starts) if (each := self.draw()) is not None]
        candidates.append(self._at_rest())
        for each in candidates:
            self._keep(each)
        candidates.sort(key=self.design.gain, reverse=True)
        for number, start in enumerate(candidates[:starts], start=1):
            self._climb(start, number, starts, iterations)
        assert self.best is not None
        return self.best

    def _climb(self, start: FloatArray, number: int, starts: int, iterations: int) -> None:
        count = 0

        def after(point: FloatArray) -> None:
            nonlocal count
            count += 1
            if count % KEEP_EVERY == 0:
                self._keep(point.reshape(self._shape))
            if self._report is not None:
                self._report(Progress(number, starts, count, self.best_gain))

        def loss(point: FloatArray) -> float:
            return -self._at(point)[0].gain

        def slope(point: FloatArray) -> FloatArray:
            return -self._gradient(point)

        limits: Any = {
            "type": "ineq",
            "fun": lambda point: self._at(point)[1],
            "jac": lambda point: self._at(point)[2],
        }
        options: Any = {"maxiter": iterations, "ftol": CONVERGED}
        search: Any = minimize  # its type hints have no case for such constraints
        found = search(
            loss,
            start.ravel(),
            jac=slope,
            method="SLSQP",
            constraints=limits,
            callback=after,
            options=options,
        )
        self._keep(found.x.reshape(self._shape))

    def _gradient(self, point: FloatArray) -> FloatArray:
        slopes = self._at(point)[0].gain_slopes
        gradient: FloatArray = np.einsum("otm,otd->md", self._basis, slopes).ravel()
        return gradient

    def _at(self, point: FloatArray) -> tuple[Evaluation, FloatArray, FloatArray]:
        """Return the evaluation, constraints (c,) that must not be negative, and their slopes."""
        key = point.tobytes()
        if self._cached is None or self._cached[0] != key:
            motion = self._basis @ point.reshape(self._shape)
            evaluation = self.design.expected.evaluate(motion, self.design.repeats)
            self._cached = key, evaluation, *self._constraints(motion, evaluation)
        return self._cached[1:]

    def _constraints(
        self, motion: FloatArray, evaluation: Evaluation
    ) -> tuple[FloatArray, FloatArray]:
        limits, joints = self.design.limits, range(self._shape[1])
        values: list[float] = []
        slopes: list[FloatArray] = []

        def add(shares: FloatArray, changes: FloatArray) -> None:
            """Add 1 - max |shares| of shares (N,) with sensitivities (3, N, D) to the motion."""
            largest, weight = smooth_maximum(np.concatenate([shares, -shares]))
            signed = weight[: len(shares)] - weight[len(shares) :]
            values.append(1.0 - largest)
            slope = np.einsum("otm,t,otd->md", self._basis, signed, changes)
            slopes.append(-slope.ravel())

        scales = (limits.half_width, limits.speed, limits.acceleration)
        for order, scale in enumerate(scales):
            offset = limits.centre if order == 0 else np.zeros(len(scale))
            for joint in joints:
                changes = np.zeros(motion.shape)
                changes[order, :, joint] = 1.0 / scale[joint]
                add((motion[order, :, joint] - offset[joint]) / scale[joint], changes)
        for joint, index in enumerate(self.design.expected.joints.indices):
            effort = limits.effort[joint]
            if np.isfinite(effort):
                changes = evaluation.torque_slopes[:, :, index] / effort
                add(evaluation.torque[:, index] / effort, changes)
        return np.array(values), np.array(slopes)

    def _keep(self, coefficients: FloatArray) -> None:
        """Store coefficients, shrunk into the limits if needed, if they are the best so far."""
        if not np.all(np.isfinite(coefficients)) or self.design.gain(coefficients) < self.best_gain:
            return
        scale = self._largest_scale(coefficients, largest=1.0)
        if scale <= 0:
            return
        feasible = self._shrunk(coefficients, scale)
        gain = self.design.gain(feasible)
        if gain > self.best_gain:
            self.best, self.best_gain = feasible, gain

    def _largest_scale(self, coefficients: FloatArray, largest: float = 8.0) -> float:
        """Return the largest factor on the waves within all limits, 0 if the centre is not."""
        time = self.design.instants(4 * self.design.samples)
        if largest == 1.0 and self.design.excess(coefficients, time) <= 1.0:
            return 1.0
        if self.design.excess(self._shrunk(coefficients, 0.0), time[:1]) > 1.0:
            return 0.0
        low, high = 0.0, largest
        for _ in range(12):
            middle = (low + high) / 2
            fits = self.design.excess(self._shrunk(coefficients, middle), time) <= 1.0
            low, high = (middle, high) if fits else (low, middle)
        return low

    @staticmethod
    def _shrunk(coefficients: FloatArray, scale: float) -> FloatArray:
        scaled = scale * coefficients
        scaled[0] = coefficients[0]
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
        joints = self.design.expected.joints
        coefficients[0] = joints.posture[list(joints.indices)]
        return coefficients


def smooth_maximum(values: FloatArray) -> tuple[float, FloatArray]:
    """Return a smooth upper bound of the largest of (N,) values, and its slopes (N,)."""
    largest = values.max()
    powers = np.exp(SHARPNESS * (values - largest))
    total = powers.sum()
    return float(largest + np.log(total) / SHARPNESS), powers / total
