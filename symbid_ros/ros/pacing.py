"""Simulated time beside real time."""

import time
from dataclasses import dataclass, field

CATCH_UP = 0.1  # s; a schedule further behind than this is not made up for


@dataclass
class Schedule:
    """Deadlines of equal periods on the monotonic clock; ROS timers would skip ticks.

    What is a little late catches up. What was held up for longer, by a pause, a new start or a
    slow controller, goes on at its pace instead of racing.

    Attributes
    ----------
    period_ns : float
        Real nanoseconds from one deadline to the next.
    late : int
        Deadlines missed by a period or more.
    elapsed_ns : int
        From restarts to the deadlines after them, what lay before the restarts left out.
    """

    period_ns: float
    late: int = 0
    elapsed_ns: int = 0
    _next: float = field(init=False)
    _last: int = field(init=False)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Make now the next deadline."""
        self._next = self._last = time.monotonic_ns()

    def wait(self) -> None:
        """Sleep until the next deadline, unless it has passed."""
        ahead = self._next - time.monotonic_ns()
        if ahead > 0:
            time.sleep(ahead / 1e9)
        elif -ahead >= self.period_ns:
            self.late += 1
            if -ahead > CATCH_UP * 1e9:
                self._next = time.monotonic_ns()
        self._next += self.period_ns
        now = time.monotonic_ns()
        self.elapsed_ns += now - self._last
        self._last = now
