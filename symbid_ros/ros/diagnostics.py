"""The status of a node on ``/diagnostics``, published once a second."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from symbid_ros.ros.endpoints import reliable_qos

PERIOD = 1.0  # s
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@dataclass(frozen=True)
class NodeStatus:
    """One status.

    Attributes
    ----------
    part : str
        Of the node; the status is named ``<node>: <part>``.
    level : bytes
        ``OK``, ``WARN`` or ``ERROR``.
    message : str
    values : mapping of str to object
        Figures in constant order.
    """

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class StatusPublisher:
    """Publishes a node's health while its executor spins.

    Parameters
    ----------
    node : Node
    look : callable
        Returns the statuses of this moment.
    hardware_id : str
        Which robot or bag they are about.
    """

    def __init__(
        self, node: Node, look: Callable[[], Sequence[NodeStatus]], hardware_id: str
    ) -> None:
        self._node, self._look, self._hardware_id = node, look, hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", reliable_qos(10))
        # Simulated time may stand still, and health is asked for then most of all.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD, self._publish, clock=steady)

    def _publish(self) -> None:
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=health.level,
                hardware_id=self._hardware_id,
                name=f"{name}: {health.part}",
                message=health.message,
                values=[
                    KeyValue(key=key, value=str(value)) for key, value in health.values.items()
                ],
            )
            for health in (*self._look(), *self._messages())
        ]
        self._publisher.publish(message)

    def _messages(self) -> Sequence[NodeStatus]:
        """Return what the node's executor had to drop; nothing as long as there is nothing."""
        dropped = getattr(self._node.executor, "dropped", {})
        if not dropped:
            return ()
        message = f"messages dropped on {', '.join(sorted(dropped))}"
        return (NodeStatus("messages", WARN, message, dict(sorted(dropped.items()))),)
