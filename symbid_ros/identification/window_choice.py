"""Which length of windows live estimates are made over."""

from symbid_ros.identification.problem import Problem
from symbid_ros.identification.window_comparison import WindowComparison

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
