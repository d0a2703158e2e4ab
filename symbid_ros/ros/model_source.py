"""Takes identified models from an identifier's topics into the balance controller."""

from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from symbid_ros.errors import SymbidError
from symbid_ros.estimation.model_gate import CandidateModel, ModelGate
from symbid_ros.ros.endpoints import latched_qos, reliable_qos
from symbid_ros.ros.monitor_messages import RobotEstimate, read_estimate
from symbid_ros.ros.reporting import OK, WARN, NodeStatus
from symbid_ros.simulation.standing_controller import StandingController

QUEUE = 10  # messages of /diagnostics
# Parts of the identifier's status that tell whether its estimate can be trusted.
TRUSTED_PARTS = "estimate", "change"


@dataclass(frozen=True)
class _News:
    """An estimate and the alarms that were published after it."""

    estimate: RobotEstimate
    alarms: tuple[str, ...]


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
        self._gate = ModelGate(largest_change)
        self._identifier: str = node.resolve_topic_name("identifier")
        self._estimate: RobotEstimate | None = None
        self._statuses: dict[str, DiagnosticStatus] = {}
        self._news: _News | None = None
        self._counts = {"accepted": 0, "refused": 0, "withdrawn": 0}
        # Which model is used, which one was used before, and why the newest one is not.
        self._used = self._before = self._refusal = ""
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
        logger, controller = self._node.get_logger(), self._controller
        links = news.estimate.links
        candidate = CandidateModel(
            tuple(link.name for link in links),
            np.array([link.phi for link in links]),
            np.array([link.std for link in links]),
            news.alarms,
        )
        is_news = self._gate.is_news(candidate)
        if controller.is_changing:
            if news.alarms and self._used != self._before:
                controller.fall_back()
                self._counts["withdrawn"] += 1
                self._used = self._before
                logger.warning(f"the model is withdrawn: {news.alarms[0]}")
            return
        if not is_news:
            self._refusal = ""
            return
        reason = self._adopt(candidate)
        if not reason:
            self._counts["accepted"] += 1
            self._before = self._used
            self._used = f"identified until {news.estimate.stamp * 1e-9:.3f} s"
            logger.info(f"model {self._used} replaces the present one")
        elif reason != self._refusal:
            self._counts["refused"] += 1
            logger.warning(f"the identified model is not used: {reason}")
        self._refusal = reason

    def status(self) -> NodeStatus:
        """Return which model the controller uses."""
        message = self._used or "model of the file"
        if self._refusal:
            message += f"; the newest is not used: {self._refusal}"
        return NodeStatus("model", WARN if self._refusal else OK, message, dict(self._counts))

    def _adopt(self, candidate: CandidateModel) -> str:
        """Let the controller use a model; return why not if it must not."""
        controller = self._controller
        fault = self._gate.fault(candidate)
        if fault:
            return fault
        try:
            proposal = controller.propose(dict(zip(candidate.links, candidate.phi, strict=True)))
        except SymbidError as error:
            return str(error)
        reason = self._gate.refusal(candidate, proposal.torque_change, controller.torque_limits)
        if not reason:
            controller.adopt(proposal)
        return reason

    def _on_estimate(self, message: DiagnosticArray) -> None:
        self._estimate = read_estimate(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        parts = {f"{self._identifier}: {part}" for part in TRUSTED_PARTS}
        found = {status.name: status for status in message.status if status.name in parts}
        self._statuses.update(found)
        estimate, self._estimate = self._estimate, None if found else self._estimate
        if not found or estimate is None:
            return
        alarms = tuple(
            status.message
            for status in self._statuses.values()
            if status.level != DiagnosticStatus.OK
        )
        self._news = _News(estimate, alarms)
