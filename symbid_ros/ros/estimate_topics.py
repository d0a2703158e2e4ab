"""The topics on which an identifier publishes what it found."""

from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.ros import estimate_messages as messages
from symbid_ros.ros.messages import latched


class EstimateTopics:
    """Latched publishers of an estimate's parts.

    Parameters
    ----------
    node : Node
        Whose private names the topics have.
    parameters : ParameterSet
        The robot's columns.
    """

    def __init__(self, node: Node, parameters: ParameterSet) -> None:
        def publisher(kind: type[Any], topic: str) -> Publisher:
            return node.create_publisher(kind, f"~/{topic}", latched())

        model = parameters.model
        self._base = model.links[0].name
        self._inertia, self._inertia_stddev = (
            {
                link: publisher(InertiaStamped, f"{name}/{messages.topic_token(link)}")
                for link in parameters.link_names
            }
            for name in ("inertia", "inertia_stddev")
        )
        self._estimate = publisher(DiagnosticArray, "estimate")
        self._effort_residual = publisher(JointState, "effort_residual")
        self._wrench_residual = (
            publisher(WrenchStamped, "wrench_residual") if model.floating else None
        )
        self._robot = publisher(String, "robot_description")

    def publish(self, estimate: Estimate, stamp: Time) -> None:
        """Publish all but the robot description, ``stamp`` being the newest data's."""
        for link, publisher in self._inertia.items():
            publisher.publish(messages.inertia_message(estimate, link, stamp))
        for link, publisher in self._inertia_stddev.items():
            publisher.publish(messages.inertia_stddev_message(estimate, link, stamp))
        self._effort_residual.publish(messages.effort_residual_message(estimate, stamp))
        if self._wrench_residual is not None:
            self._wrench_residual.publish(
                messages.wrench_residual_message(estimate, self._base, stamp)
            )
        self._estimate.publish(messages.estimate_message(estimate, stamp))

    def describe(self, urdf: str) -> None:
        """Publish the identified robot."""
        # A comment in an encoding other than UTF-8 comes as surrogates, which no message can hold.
        self._robot.publish(String(data=urdf.encode(errors="replace").decode()))
