"""Takes identified models from an identifier's topics into the balance controller."""

from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.learning.model_update import ACCEPTED, ModelUpdate
from symbid_ros.ros.endpoints import latched_qos, reliable_qos
from symbid_ros.ros.monitor_messages import (
    IdentifierStatus,
    RobotEstimate,
    read_estimate,
    read_status,
)
from symbid_ros.ros.reporting import OK, WARN, NodeStatus
from symbid_ros.simulation.standing_controller import StandingController

QUEUE = 10  # messages of /diagnostics
# Parts of the identifier's status that tell whether its estimate can be trusted, and whether the
# robot is still the same.
ESTIMATE, CHANGE = "estimate", "change"


@dataclass(frozen=True)
class _News:
    """An estimate, and the status, alarms and change that were published after it."""

    estimate: RobotEstimate
    known: IdentifierStatus
    alarms: tuple[str, ...]
    change: str


class ModelSource:
    """Watches an identifier, and lets a controller use its models as long as they can be trusted.

    The node's executor calls the subscriptions; the controller's thread calls :meth:`update`. A
    model is judged when the identifier's status has followed the estimate.

    Parameters
    ----------
    node : Node
        Its ``identifier`` is the name of the identifying node, which may be remapped.
    controller : StandingController
    largest_change : float
        Largest change of a drive's torque that a model may cause, as a share of its limit.
    """

    def __init__(self, node: Node, controller: StandingController, largest_change: float) -> None:
        self._node, self._controller = node, controller
        self._models = ModelUpdate(controller, largest_change)
        self._identifier: str = node.resolve_topic_name("identifier")
        self._estimate: RobotEstimate | None = None
        self._statuses: dict[str, DiagnosticStatus] = {}
        self._news: _News | None = None
        node.create_subscription(
            DiagnosticArray, f"{self._identifier}/estimate", self._on_estimate, latched_qos()
        )
        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, reliable_qos(QUEUE)
        )

    def update(self) -> None:
        """Judge the newest model, if there is one."""
        news, self._news = self._news, None
        if news is None or not news.estimate.links:
            return
        links, known = news.estimate.links, news.known
        candidate = CandidateModel(
            tuple(link.name for link in links),
            np.array([link.phi for link in links]),
            np.array([link.std for link in links]),
            news.alarms,
            mass_std=_finite(known.number("mass/std")),
            com_std=_finite(known.number("com/std")),
            change=news.change,
        )
        label = f"identified until {news.estimate.stamp * 1e-9:.3f} s"
        decision = self._models.judge(candidate, label)
        if decision is None:
            return
        logger = self._node.get_logger()
        if decision.kind == ACCEPTED:
            logger.info(decision.message)
        else:
            logger.warning(decision.message)

    def status(self) -> NodeStatus:
        """Return which model the controller uses."""
        models = self._models
        message = models.used or "model of the file"
        if models.refusal:
            message += f"; the newest is not used: {models.refusal}"
        values = {**models.counts, "reach": f"{self._controller.wanted_reach:.2f}"}
        return NodeStatus("model", WARN if models.refusal else OK, message, values)

    def _on_estimate(self, message: DiagnosticArray) -> None:
        self._estimate = read_estimate(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        names = {f"{self._identifier}: {part}": part for part in (ESTIMATE, CHANGE)}
        found = {names[one.name]: one for one in message.status if one.name in names}
        self._statuses.update(found)
        estimate, self._estimate = self._estimate, None if found else self._estimate
        if not found or estimate is None:
            return
        warnings = {
            part: status.message
            for part, status in self._statuses.items()
            if status.level != DiagnosticStatus.OK
        }
        self._news = _News(
            estimate,
            read_status(self._statuses),
            tuple(message for part, message in warnings.items() if part == ESTIMATE),
            warnings.get(CHANGE, ""),
        )


def _finite(number: float) -> float | None:
    return number if np.isfinite(number) else None
