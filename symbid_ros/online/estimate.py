"""An estimate of a live identification."""

from dataclasses import dataclass

from symbid_ros.identification.identification import Identification
from symbid_ros.identification.rows.change_monitor import Change
from symbid_ros.model.parameters import ParameterSet


@dataclass(frozen=True)
class OnlineEstimate:
    """An estimate and the time of its newest data.

    Attributes
    ----------
    found : Identification
        The estimate and its observations; has a verdict only if solved exactly.
    parameters : ParameterSet
        The estimate's parameters, with the joint terms that the data ask for.
    until : int
        Stamp of the newest data in it, ns.
    window : float
        Length of the rows' windows, s.
    alarms : tuple of str
        Problems of the estimate, one line each.
    is_contradicted : bool
        Whether more of a force is unexplained than measured, which no joint term would change.
    change : Change or None
        Detected change of the robot, which contradicts the estimate.
    followed : Change or None
        The last change, if the estimate is from data since then.
    """

    found: Identification
    parameters: ParameterSet
    until: int
    window: float
    alarms: tuple[str, ...]
    is_contradicted: bool
    change: Change | None
    followed: Change | None
