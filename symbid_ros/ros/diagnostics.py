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
    """The status of one part of a node.

    Attributes
    ----------
    part : str
        Part of the node; the status is named ``<node>: <part>``.
    level : bytes
        ``OK``, ``WARN`` or ``ERROR``.
    message : str
    values : mapping of str to object
        Key-value pairs in a constant order.
    """

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class StatusPublisher:
    """Publishes the statuses of a node while its executor spins.

    Parameters
    ----------
    node : Node
    current : callable
        Returns the current statuses.
    hardware_id : str
        Name of the robot or bag.
    """

    def __init__(
        self, node: Node, current: Callable[[], Sequence[NodeStatus]], hardware_id: str
    ) -> None:
        self._node, self._current, self._hardware_id = node, current, hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", reliable_qos(10))
        # The status must be published even while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD, self._publish, clock=steady)

    def _publish(self) -> None:
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=status.level,
                hardware_id=self._hardware_id,
                name=f"{name}: {status.part}",
                message=status.message,
                values=[
                    KeyValue(key=key, value=str(value)) for key, value in status.values.items()
                ],
            )
            for status in (*self._current(), *self._dropped_messages())
        ]
        self._publisher.publish(message)

    def _dropped_messages(self) -> Sequence[NodeStatus]:
        """Return a warning if the node's executor has dropped messages or requests."""
        dropped = getattr(self._node.executor, "dropped", {})
        if not dropped:
            return ()
        message = f"messages or requests dropped on {', '.join(sorted(dropped))}"
        return (NodeStatus("messages", WARN, message, dict(sorted(dropped.items()))),)
