"""Services, parameters and statuses of nodes on a test's graph."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterValue, SetParametersResult
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)


def call(graph, kind: type[Any], service: str, **request: Any) -> Any:
    client = graph.node.create_client(kind, service)
    graph.wait_until(client.service_is_ready)
    answer = client.call_async(kind.Request(**request))
    graph.wait_until(answer.done)
    graph.node.destroy_client(client)
    return answer.result()


def set_parameters(graph, node: str, **values: Any) -> list[SetParametersResult]:
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return call(graph, SetParameters, f"{node}/set_parameters", parameters=parameters).results


def parameter(graph, node: str, name: str) -> ParameterValue:
    (value,) = call(graph, GetParameters, f"{node}/get_parameters", names=[name]).values
    return value


def descriptors(graph, node: str, names: list[str]) -> list[Any]:
    service = f"{node}/describe_parameters"
    return call(graph, DescribeParameters, service, names=names).descriptors


class StatusProbe:
    """The newest status of each name with its values, and the number of statuses."""

    def __init__(self, graph) -> None:
        self._statuses: dict[str, Any] = {}
        self.received = 0
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, RELIABLE)

    def _keep(self, message: DiagnosticArray) -> None:
        self.received += 1
        self._statuses.update({status.name: status for status in message.status})

    def message(self, name: str) -> str:
        return self._statuses[name].message if name in self._statuses else ""

    def level(self, name: str) -> bytes:
        return self._statuses[name].level

    def value(self, name: str, key: str) -> str:
        if name not in self._statuses:
            return ""
        return {each.key: each.value for each in self._statuses[name].values}[key]

    def count(self, name: str, key: str) -> int:
        return int(self.value(name, key) or 0)
