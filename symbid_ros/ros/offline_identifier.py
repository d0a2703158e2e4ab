"""The identifier's offline half: bags in, an estimate on latched topics out."""

from threading import Event
from typing import Any

from rclpy.node import Node

from symbid_ros.identification.export import export_urdf, write_identification
from symbid_ros.offline.identify import prepare
from symbid_ros.ros.estimate_messages import estimate_health
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.health import HealthPublisher
from symbid_ros.ros.identifier_parameters import given_path, job_from
from symbid_ros.shutdown import interruptible


class OfflineIdentifier:
    """Solves a job and keeps its result on the topics until stopped."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        self._job = job_from(values)
        self._out = given_path(values["out"])

    def run(self, stop: Event) -> None:
        """Identify, publish, and say once a second that the estimate stands."""
        with interruptible(stop):  # it takes minutes where the bag is long
            prepared = prepare(self._job, self._out)
            found = prepared.solve(self._job.method)
        estimate = found.estimate
        if self._out is not None:
            write_identification(found, prepared.parameters, self._out)
        topics = EstimateTopics(self._node, prepared.parameters)
        topics.publish(estimate, self._node.get_clock().now().to_msg())
        topics.describe(export_urdf(estimate, prepared.parameters))
        self._node.get_logger().info(
            f"estimate of {estimate.model} by {estimate.method}: {estimate.samples} rows per "
            "coordinate"
        )
        verdict = estimate.verdict
        alarms = () if verdict is None else verdict.alarms
        facts = {} if verdict is None else {"window": f"{verdict.window:g}"}
        HealthPublisher(
            self._node, lambda: [estimate_health(estimate, alarms, facts)], estimate.model
        )
        stop.wait()
