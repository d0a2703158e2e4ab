"""Choice of the window length with the most informative rows."""

from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.alarms import SUSPICIOUS_NOISE
from symbid_ros.estimation.change import discounted_prior, discounted_pseudo_measurements
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior, posterior
from symbid_ros.identification.problem import Problem

# Change, in posterior standard deviations, at which iterations stop for a comparison.
COMPARABLE = 1e-2

# Share of a coordinate's independent rows that parameters fit, above which its residuals no longer
# measure the noise: the weight that they give it grows until the fit is exact.
MOST_FITTED = 0.5

# RMS of what an estimate adds to the residual of shorter windows' rows, as a share of the measured
# forces, above which it misses what fast motion shows.
MISSED_MOTION = 0.05

# Share of the largest gain below which rows are not informative, such as those of so few long
# windows that no coordinate gets a weight.
LEAST_GAIN = 0.1

# Factor by which the number of blocks grows between two comparisons online.
COMPARE_AGAIN = 2


class WindowComparison:
    """Compares the window lengths of a problem, all at once or step by step.

    If sensor noise in the motion dominates some direction, the bias exceeds the standard
    deviations. If parameters fit most rows of a coordinate, its weight and the information are only
    apparent, as with long windows of a coordinate that is seldom used. If the model lacks an effect
    that is fast, long windows average it, and their estimate errs where it is felt: it predicts the
    rows of shorter windows worse than their own estimate does. Such window lengths are chosen only
    if all are like that.

    Parameters
    ----------
    problem : Problem
        With data for at least one window length.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        needs_longest = problem.needs_longest_window
        self._candidates = problem.observations[-1:] if needs_longest else problem.observations
        self._found: list[Posterior] = []

    @property
    def is_done(self) -> bool:
        """Whether every window length has been solved; a single one need not be."""
        return len(self._found) == len(self._candidates) or len(self._candidates) == 1

    def step(self) -> None:
        """Solve one more window length."""
        # The order is clear long before weights and solution have converged.
        one = self._candidates[len(self._found)]
        near = self._found[-1].mean if self._found else None
        self._found.append(solve_window(self._problem, one, near, COMPARABLE, approximate=True))

    def finish(self) -> tuple[Observations, Posterior | None]:
        """Return the most informative rows and, if they were solved, their posterior."""
        while not self.is_done:
            self.step()
        if not self._found:
            return self._candidates[0], None
        best = _most_informative(self._found, self._candidates, len(self._problem.parameters))
        return self._candidates[best], self._found[best]


class WindowSelector:
    """Repeats the comparison as data arrive, one window length at each estimate after the first.

    A full comparison takes as long as several estimates, which would be late.
    """

    def __init__(self) -> None:
        self._comparison: WindowComparison | None = None
        self._compared_at = 0

    def update(self, problem: Problem, count: int) -> float | None:
        """Solve one more window length; return the best one, s, at the end of a comparison.

        The data of the problem are those of ``count`` complete blocks.
        """
        # A comparison that fails is repeated only when there are more blocks.
        comparison, self._comparison = self._comparison, None
        if comparison is not None:
            comparison.step()
        elif count >= COMPARE_AGAIN * self._compared_at:
            comparison = WindowComparison(problem)
            is_first, self._compared_at = not self._compared_at, max(count, 1)
            if is_first:  # the first estimates wait for the result
                comparison.finish()
        if comparison is None:
            return None
        if not comparison.is_done:
            self._comparison = comparison
            return None
        best, _ = comparison.finish()
        return best.window


def solve_window(
    problem: Problem,
    one: Observations,
    start: FloatArray | None,
    tolerance: float,
    *,
    approximate: bool = False,
) -> Posterior:
    """Return a problem's posterior for one window length.

    Parameters
    ----------
    problem : Problem
    one : Observations
        With that window length; the prior is discounted like these rows.
    start : (p,) float64 or None
        Parameters near the solution.
    tolerance : float
        Change, in posterior standard deviations, at which iterations stop.
    approximate : bool
        Whether weights need not converge to the last digits.
    """
    # Offline, `kept` is 1, and discounting by 1 changes no digit.
    return posterior(
        one,
        discounted_prior(problem.prior, one.kept),
        discounted_pseudo_measurements(problem.pseudo_measurements, one.kept),
        empirical=problem.is_empirical,
        count=problem.parameters.inertial,
        tolerance=tolerance,
        start=start,
        approximate=approximate,
    )


def _most_informative(found: Sequence[Posterior], rows: Sequence[Observations], count: int) -> int:
    """Return the index of the most informative rows for the first ``count`` parameters."""
    noise, fitted = np.zeros(len(found)), np.zeros(len(found))
    for index, (one, data) in enumerate(zip(found, rows, strict=True)):
        factor = one.independent_factor
        noise[index] = one.noise_share
        fitted[index] = data.fitted_share(factor @ factor.T, one.covariance).max()
    gain = np.array([one.gain(count) for one in found])
    best = gain.max()
    is_informative = gain >= min(LEAST_GAIN * best, best)  # even if rounding makes all negative
    is_clean = noise <= max(SUSPICIOUS_NOISE, noise[is_informative].min())
    is_redundant = fitted <= max(MOST_FITTED, fitted[is_informative].min())

    def misses_motion(index: int) -> bool:
        shorter = np.flatnonzero((is_informative & is_clean & is_redundant)[:index]).tolist()
        added = [_added_residual(rows[one], found[index], found[one]) for one in shorter]
        return max(added, default=0.0) > MISSED_MOTION

    def rank(index: int) -> tuple[float, ...]:
        flags = is_informative[index], is_clean[index], is_redundant[index]
        return *map(bool, flags), not misses_motion(index), float(gain[index])

    return max(range(len(found)), key=rank)


def _added_residual(rows: Observations, one: Posterior, best: Posterior) -> float:
    """Return what an estimate adds to the residual of rows that another one fits best.

    RMS of all coordinates together, relative to the measured forces.
    """
    count = np.maximum(rows.counts.diagonal(), 1.0)
    mean_squares = [
        float(np.sum(squares / count))
        for squares in (
            rows.rows.residual_moment(one.mean).diagonal(),
            rows.rows.residual_moment(best.mean).diagonal(),
            rows.rows.target_squares,
        )
    ]
    added = max(mean_squares[0] - mean_squares[1], 0.0)
    return float(np.sqrt(added / mean_squares[2])) if mean_squares[2] > 0 else 0.0
