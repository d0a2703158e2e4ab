"""The end of a run before its time."""

from symbid_ros.errors import SimulationError


class BreakdownError(SimulationError):
    """A robot that cannot go on: fallen, at an end stop, or without a command.

    Parameters
    ----------
    cause : str
        What happened, without time and remedy.
    time : float
        When, s; negative while the robot settles.
    remedy : str
        What to do about it.
    """

    def __init__(self, cause: str, time: float, remedy: str) -> None:
        super().__init__(f"{cause} at {time:.3f} s; {remedy}")
        self.cause = cause
        self.time = time
