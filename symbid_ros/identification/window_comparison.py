"""Choice of the window length whose rows tell most about a robot."""

from collections.abc import Sequence

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.change import discounted_prior, discounted_pseudo_measurements
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior, posterior
from symbid_ros.estimation.verdict import SUSPICIOUS_NOISE
from symbid_ros.identification.problem import Problem

# Change, in posterior deviations, at which windows of several lengths can be compared.
COMPARABLE = 1e-2


class WindowComparison:
    """The windows of a problem, compared one after the other, at once or in steps.

    Where noise is most of what some direction is told, its estimate leaves a bias larger than the
    deviations: such windows are passed over for others.

    Parameters
    ----------
    problem : Problem
        With data over one length of windows at least.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._candidates = problem.observations[-1:] if problem.longest else problem.observations
        self._found: list[Posterior] = []

    @property
    def is_done(self) -> bool:
        """Whether no window is left; a single one need not be looked at."""
        return len(self._found) == len(self._candidates) or len(self._candidates) == 1

    def step(self) -> None:
        """Look at one window more."""
        # Which of them it is shows long before weights and solution have settled.
        one = self._candidates[len(self._found)]
        near = self._found[-1].mean if self._found else None
        self._found.append(solved(self._problem, one, near, COMPARABLE, approximate=True))

    def finish(self) -> tuple[Observations, FloatArray | None]:
        """Look at all and return what tells most, and parameters near its solution if known."""
        while not self.is_done:
            self.step()
        if not self._found:
            return self._candidates[0], None
        best = _telling(self._found, len(self._problem.parameters))
        return self._candidates[best], self._found[best].mean


def solved(
    problem: Problem,
    one: Observations,
    start: FloatArray | None,
    tolerance: float,
    *,
    approximate: bool = False,
) -> Posterior:
    """Return a problem's posterior over one length of windows.

    Parameters
    ----------
    problem : Problem
    one : Observations
        Over those windows; where rows have faded, the prior has as well.
    start : (p,) float64 or None
        Parameters near the solution.
    tolerance : float
        Change, in posterior deviations, at which it will do.
    approximate : bool
        Whether the weights' last digits are spared.
    """
    # Nothing has faded unless old rows have, and 1 changes no digit.
    return posterior(
        one,
        discounted_prior(problem.prior, one.kept),
        discounted_pseudo_measurements(problem.pseudo_measurements, one.kept),
        empirical=problem.empirical,
        count=problem.parameters.inertial,
        tolerance=tolerance,
        start=start,
        approximate=approximate,
    )


def _telling(found: Sequence[Posterior], count: int) -> int:
    """Return which window tells most of the first ``count`` parameters."""
    shares = [one.noise_share for one in found]
    allowed = max(SUSPICIOUS_NOISE, min(shares))
    gains = [one.gain(count) for one in found]
    return max(range(len(found)), key=lambda i: (shares[i] <= allowed, gains[i]))


# Windows are compared again when there are so many times more blocks than at the last time.
COMPARE_AGAIN = 2


class WindowChoice:
    """Windows compared again and again as data come, one at each estimate but for the first.

    All at once would take as long as a few estimates, which would have to wait.
    """

    def __init__(self) -> None:
        self._comparison: WindowComparison | None = None
        self._compared_at = 0

    def look(self, problem: Problem, blocks: int) -> float | None:
        """Compare one length more, and return which tells most, s, where all have been compared.

        Parameters
        ----------
        problem : Problem
            By whole blocks, with data.
        blocks : int
            How many they are.
        """
        # What fails is not tried again before there are more blocks.
        comparison, self._comparison = self._comparison, None
        if comparison is not None:
            comparison.step()
        elif blocks >= COMPARE_AGAIN * self._compared_at:
            comparison = WindowComparison(problem)
            is_first, self._compared_at = not self._compared_at, max(blocks, 1)
            if is_first:  # nothing is known yet: the first estimates wait for it
                comparison.finish()
        if comparison is None:
            return None
        if not comparison.is_done:
            self._comparison = comparison
            return None
        best, _ = comparison.finish()
        return best.window
