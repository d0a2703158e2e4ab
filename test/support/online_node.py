"""The online identifier as a process, and an observer of what it publishes."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from symbid_ros.package_paths import config_file

MODEL = config_file("symbitron.xml")
SENSORS = "[joint_states, imu/data, left_foot/wrench, right_foot/wrench]"
LINKS = {"joint_terms": "none"}  # half the work where joint terms do not matter
LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class EstimateProbe:
    """The identifier's newest estimate, and its statuses by part."""

    def __init__(self, graph: Any) -> None:
        self.estimates: list[DiagnosticArray] = []
        self.statuses: dict[str, Any] = {}
        graph.node.create_subscription(
            DiagnosticArray, "/identifier/estimate", self.estimates.append, LATCHED
        )
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        graph.details = lambda: (len(self.estimates), self.statuses)

    def _keep(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node, _, part = status.name.partition(": ")
            if node == "/identifier":
                self.statuses[part] = status

    def values(self, part: str) -> dict[str, str]:
        status = self.statuses.get(part)
        return {} if status is None else {entry.key: entry.value for entry in status.values}

    def times(self) -> list[float]:
        """Return the time of the newest data in each estimate, s."""
        stamps = [estimate.header.stamp for estimate in self.estimates]
        return [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]

    def until(self) -> float:
        """Return the time of the newest data in the newest estimate, s."""
        return self.times()[-1]


def call(graph: Any, kind: type, service: str, request: Any = None) -> Any:
    client = graph.node.create_client(kind, service)
    graph.wait_until(client.service_is_ready)
    answer = client.call_async(kind.Request() if request is None else request)
    graph.wait_until(answer.done)
    return answer.result()


def identifier(graph: Any, **parameters: object) -> Any:
    return graph.start("identifier", model=MODEL, prior_percent=25.0, **parameters)


def bridge(graph: Any, **parameters: object) -> Any:
    return graph.start("mujoco_bridge", wait_for_subscribers=True, **parameters)
