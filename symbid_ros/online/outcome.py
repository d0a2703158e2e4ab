"""What an online identification knows at one time."""

from dataclasses import dataclass

from symbid_ros.identification.change_monitor import Change
from symbid_ros.identification.solver import Identification


@dataclass(frozen=True)
class Outcome:
    """An estimate and up to when it knows the robot.

    Attributes
    ----------
    found : Identification
        The estimate, with the observations behind it; its verdict only if solved exactly.
    until : int
        Stamp of the newest data in it, ns.
    window : float
        Length of the rows' windows, s.
    alarms : tuple of str
        What is wrong, one line each.
    change : Change or None
        What the robot has changed in, if it has.
    """

    found: Identification
    until: int
    window: float
    alarms: tuple[str, ...]
    change: Change | None
