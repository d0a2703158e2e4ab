"""Which topics of a full graph are used as the robot's."""

from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.ros.raw_subscription import PolledGroup, subscribe
from symbid_ros.ros.sensor_topics import SensorTopics, resolve_topics

OWN = {
    "/joint_states": (JointState, ""),
    "/imu/data": (Imu, "imu_link"),
    "/left_foot/wrench": (WrenchStamped, "left_sole"),
    "/right_foot/wrench": (WrenchStamped, "right_sole"),
}
FOREIGN = {
    "/dummy/joint_states": (JointState, ""),
    "/camera/imu": (Imu, "camera_imu_optical_frame"),
    "/imu/data_raw": (Imu, "imu_link"),  # the same sensor on a second topic
    "/hand/wrench": (WrenchStamped, "hand"),
    "/ground_truth/joint_states": (JointState, ""),
    **{f"/robot2{name}": kind for name, kind in OWN.items()},
}


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


class Publishers:
    """Publishers, and the topics that a robot's identifier selects among them."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self._nodes: list[Node] = []
        self._robot = self.node("robot")
        self._publishers: list[tuple[Any, Any]] = []

    def node(self, name: str, **options: Any) -> Node:
        self._nodes.append(Node(name, context=self.context, **options))
        return self._nodes[-1]

    def publish(self, topics: dict[str, tuple[type, str]]) -> None:
        for name, (kind, frame) in topics.items():
            message = kind()
            if kind is not String:
                message.header.frame_id = frame
            self._publishers.append((self._robot.create_publisher(kind, name, 10), message))

    def selected_topics(self, sensors: SensorTopics) -> set[str]:
        """Return the names of the selected topics once the search is complete."""
        while (selected := sensors.find()) is None:
            self.publish_again()
        return {topic.name for topic in selected.all}

    def publish_again(self) -> None:
        for publisher, message in self._publishers:
            publisher.publish(message)

    def close(self) -> None:
        for node in self._nodes:
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def publishers(domain: int) -> Iterator[Publishers]:
    publishers = Publishers(domain)
    yield publishers
    publishers.close()


@pytest.fixture
def other_publishers(domain: int) -> Iterator[Publishers]:
    """A second participant, because a topic has one type in each participant."""
    other_publishers = Publishers(domain)
    yield other_publishers
    other_publishers.close()


def sensors(
    publishers: Publishers,
    model,
    *,
    settle: float = 0.0,
    arguments=(),
    selection=None,
    **options: Any,
):
    words = ["--ros-args", *arguments]
    node = publishers.node("identifier", cli_args=words, **options)
    own = resolve_topics(node, selection or TopicSelection(), words)
    return SensorTopics(node, own, model, settle, 100)


def test_only_the_robots_own_topics_are_used_in_any_order_of_appearance(
    publishers: Publishers, model
) -> None:
    publishers.publish(FOREIGN)
    found = sensors(publishers, model)
    while "/robot2/joint_states" not in found.missing()["/joint_states"]:
        publishers.publish_again()
        assert found.find() is None
    while "/camera/imu" not in found.missing():
        publishers.publish_again()
        assert found.find() is None
    assert "no frame 'camera_imu_optical_frame'" in found.missing()["/camera/imu"]
    publishers.publish(OWN)
    while found.find() is None or len(found.find().all) < len(OWN):
        publishers.publish_again()
    assert publishers.selected_topics(found) == set(OWN)


def test_topics_of_the_nodes_namespace_are_used(publishers: Publishers, model) -> None:
    publishers.publish(OWN | FOREIGN)
    found = sensors(publishers, model, namespace="/robot2")
    while (selected := found.find()) is None or len(selected.all) < len(OWN):
        publishers.publish_again()
    assert publishers.selected_topics(found) == {f"/robot2{name}" for name in OWN}


def test_a_remapped_wrench_replaces_the_topic_of_its_old_name(
    publishers: Publishers, model
) -> None:
    publishers.publish(OWN | {"/ft/left": (WrenchStamped, "left_sole")})
    found = sensors(publishers, model, arguments=["-r", "left_foot/wrench:=/ft/left"])
    while (selected := found.find()) is None or len(selected.all) < len(OWN):
        publishers.publish_again()
    assert publishers.selected_topics(found) == set(OWN) - {"/left_foot/wrench"} | {"/ft/left"}


def test_prefixed_frames_are_accepted_with_frame_prefix(publishers: Publishers, model) -> None:
    prefixed = {name: (kind, frame and f"robot1/{frame}") for name, (kind, frame) in OWN.items()}
    publishers.publish(prefixed)
    lost = sensors(publishers, model)
    while "/imu/data" not in lost.missing():
        publishers.publish_again()
        assert lost.find() is None
    assert "`frame_prefix` robot1/" in lost.missing()["/imu/data"]
    found = sensors(publishers, model, selection=TopicSelection(mapping=SensorMapping("robot1/")))
    while (selected := found.find()) is None or len(selected.all) < len(OWN):
        publishers.publish_again()
    assert publishers.selected_topics(found) == set(OWN)
    assert selected.mapping.frame_prefix == "robot1/"


def test_several_joint_state_topics_are_used_in_the_given_order(
    publishers: Publishers, model
) -> None:
    parts = ("/legs/joint_states", "/arms/joint_states")
    others = {name: what for name, what in OWN.items() if name != "/joint_states"}
    publishers.publish(others | dict.fromkeys(parts, (JointState, "")))
    found = sensors(publishers, model, selection=TopicSelection(joints=parts))
    while (selected := found.find()) is None or len(selected.all) < len(others) + len(parts):
        publishers.publish_again()
    assert tuple(topic.name for topic in selected.joints) == parts


def test_a_publisher_of_another_type_is_ignored(
    publishers: Publishers, model, other_publishers: Publishers
) -> None:
    other_publishers.publish({"/joint_states": (String, "")})
    publishers.publish(OWN)
    found = sensors(publishers, model)
    while (selected := found.find()) is None or len(selected.all) < len(OWN):
        publishers.publish_again()
    assert (
        dict(found.subscriptions(selected))[selected.clock].msgtype == "sensor_msgs/msg/JointState"
    )


def test_a_weaker_qos_offer_is_also_received_without_duplicates(publishers: Publishers) -> None:
    robot, listener = publishers.node("other"), publishers.node("listener")
    first = robot.create_publisher(Imu, "imu/data", 10)
    subscription = None
    while subscription is None:
        subscription = subscribe(listener, "/imu/data", 100, PolledGroup())
    less = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    second = robot.create_publisher(Imu, "imu/data", less)
    while second.get_subscription_count() == 0 or first.get_subscription_count() < 2:
        subscription.match_publishers()
    received: list[bytes] = []
    for number in range(20):
        message = Imu()
        message.linear_acceleration.x = float(number)
        (first, second)[number % 2].publish(message)
        while len(received) <= number:
            received += [message.payload for message in subscription.take()]
    first.wait_for_all_acked()
    received += [message.payload for message in subscription.take()]
    assert len(received) == len(set(received)) == 20
