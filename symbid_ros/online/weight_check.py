"""Whether live messages carry the robot's weight, and why they do not."""

from collections.abc import Sequence
from dataclasses import dataclass

from symbid_ros.diagnosis.findings import Finding
from symbid_ros.diagnosis.stream_checks import StreamChecks, unusable
from symbid_ros.diagnosis.wrist_evidence import check_signs
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.conventions.assumed_contacts import leg_ends
from symbid_ros.identification.problem import check_weight
from symbid_ros.messages.topics import SelectedTopics
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.signals.streams import Slice

UNIT_TIME = 2_000_000_000  # ns of messages whose units are checked


@dataclass(frozen=True)
class WeightCheck:
    """Compares measured forces with the weight of a robot.

    Attributes
    ----------
    parameters : ParameterSet
        Of the robot.
    streams : LiveStreams
        Buffered messages.
    setup_fault : str
        Why these topics cannot give an estimate; empty if they can.
    """

    parameters: ParameterSet
    streams: LiveStreams
    setup_fault: str

    def require(self, observations: Observations, prior: Prior) -> None:
        """Require forces that match the weight, and wrist sensors of the right sign.

        Raises
        ------
        DataError
            When the measured forces do not match the robot's weight, or a wrist sensor reads the
            opposite wrench.
        """
        rows = observations.rows
        check_weight(rows, self.parameters, prior, self._cause)
        check_signs(rows, self.parameters)

    def _cause(self) -> str:
        """Return why the measured forces may not carry the weight, and what to do."""
        if self.setup_fault:
            return "no wrench sensor is in use"
        units = "; ".join(one.message for one in self._wrong_units())
        return units or (
            "publish the wrench of every contact, check units (N, m/s², rad) and signs, or set "
            "`unchecked`"
        )

    def _wrong_units(self) -> Sequence[Finding]:
        """Return the findings about units in the newest messages that make a log unusable."""
        stop = self.streams.complete_until
        if stop is None:
            return ()
        start = stop - UNIT_TIME
        try:
            streams = self.streams.between(start, stop + 1)
        except SymbidError:  # reported with its block
            return ()
        checks = StreamChecks(self.parameters.model)
        checks.take(Slice(start, stop + 1, streams, {}, ()))
        return unusable(checks.unit_findings())


def setup_fault(selected: SelectedTopics, model: RobotModel) -> str:
    """Return what a floating base lacks if no wrench is measured and no contact is named."""
    if not model.floating or model.contacts is not None or selected.wrenches:
        return ""
    feet = ",".join(f"{name}:point" for name in leg_ends(model)) or "FRAME:point,..."
    return (
        "no wrench sensor is in use, so that the forces on the robot are unknown; name what "
        f"touches the ground as `contact` {feet}, or start the drivers of the wrench sensors"
    )
