"""Models given as text, by the parameter or on the topic robot_description."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.ros.endpoints import latched_qos
from symbid_ros.ros.identifier import model_file

DEADLINE = 120.0  # s; only a hang takes longer
URDF = config_file("symbitron.urdf")


@dataclass
class Graph:
    node: Node
    log: list[str]
    said: threading.Condition
    stop: threading.Event

    def wait_for(self, words: str) -> None:
        with self.said:
            assert self.said.wait_for(lambda: any(words in one for one in self.log), DEADLINE)


@pytest.fixture
def graph(domain: int) -> Iterator[Graph]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("identifier", context=context, namespace="/robot1")
    graph = Graph(node, [], threading.Condition(), threading.Event())

    def hear(message: Log) -> None:
        with graph.said:
            graph.log.append(message.msg)
            graph.said.notify()

    node.create_subscription(Log, "/rosout", hear, 100)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    spinner = threading.Thread(target=executor.spin)
    spinner.start()
    yield graph
    graph.stop.set()
    executor.shutdown()
    spinner.join()
    node.destroy_node()
    context.try_shutdown()


def values(**given) -> dict:
    return {"model": "", "robot_description": "", "base": "auto", "memory": 1.0} | given


def test_a_given_model_file_is_used_directly(graph: Graph) -> None:
    with model_file(graph.node, given := values(model="robot.urdf"), graph.stop) as found:
        assert found == given


def test_the_parameters_text_is_kept_in_a_temporary_file(graph: Graph) -> None:
    text = URDF.read_text()
    with model_file(graph.node, values(robot_description=text), graph.stop) as found:
        file = Path(found["model"])
        assert file.read_text() == text
        model = load_model(file)
        # The published description keeps its comments and meshes.
        assert urdf_text(model, file).count("<visual") == text.count("<visual")
        assert found["memory"] == 1.0
    assert not file.exists()


def test_waits_for_a_latched_model_and_reports_an_invalid_one(graph: Graph) -> None:
    found: list[str] = []

    def wait() -> None:
        with model_file(graph.node, values(), graph.stop) as complete:
            found.append(load_model(Path(complete["model"])).name)

    waiter = threading.Thread(target=wait)
    waiter.start()
    graph.wait_for("waiting for the robot's model on topic /robot1/robot_description")
    publisher = graph.node.create_publisher(String, "robot_description", latched_qos())
    publisher.publish(String(data="<robot name='a'><xacro:macro/></robot>"))
    graph.wait_for("topic /robot1/robot_description: invalid model (")
    assert waiter.is_alive()
    publisher.publish(String(data=URDF.read_text()))
    waiter.join(DEADLINE)
    assert found == [load_model(URDF).name]


def test_the_wait_can_be_stopped(graph: Graph) -> None:
    graph.stop.set()
    with model_file(graph.node, values(), graph.stop) as found:
        assert found is None
