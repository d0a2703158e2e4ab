"""Finding a robot's sensor topics on the graph."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from rclpy.node import Node

from symbid_ros.bags.container.blocks import Topic
from symbid_ros.bags.messages import IMU, JOINT_STATE
from symbid_ros.bags.streams.selection import SelectedTopics, Selector, TopicSelection
from symbid_ros.ros.intake import Intake, Polled, subscribe
from symbid_ros.ros.missing_topics import missing_topics


@dataclass
class SensorTopics:
    """Waits until the graph shows all topics that are wanted, and no more turn up.

    Each is subscribed to at first sight, so that nothing is lost meanwhile.

    Attributes
    ----------
    node : Node
    selection : TopicSelection
        Which topics are wanted.
    floating : bool
        Whether the robot's base floats, so that it needs an IMU.
    settle : float
        For how long nothing more must turn up, s.
    depth : int
        Messages that each may keep waiting.
    intakes : dict of Topic to Intake
        What has turned up so far.
    """

    node: Node
    selection: TopicSelection
    floating: bool
    settle: float
    depth: int
    intakes: dict[Topic, Intake] = field(default_factory=dict)
    _group: Polled = field(default_factory=Polled)
    _since: float = field(default_factory=time.monotonic)

    def look(self) -> SelectedTopics | None:
        """Look at the graph once; return the topics when they are complete.

        Raises
        ------
        BagError
            When it cannot be told which topic holds the joint states.
        """
        selector = Selector("live topics", self.selection)
        topics = [
            Topic(name, msgtype)
            for name, types in self.node.get_topic_names_and_types()
            for msgtype in types
        ]
        now = time.monotonic()
        for topic in topics:
            if topic not in self.intakes and selector.wants(topic) and self._is_near(topic):
                intake = subscribe(self.node, topic.name, self.depth, self._group)
                if intake is not None:
                    self.intakes[topic], self._since = intake, now
        if now - self._since < self.settle or self._lacking(self.intakes):
            return None
        selector.counts = dict.fromkeys(self.intakes, 1)
        return selector.selected()

    def missing(self) -> dict[str, str]:
        """Return what is still waited for, by topic or kind of sensor."""
        own = f"{self.node.get_fully_qualified_name()}/"
        graph = {
            name: types
            for name, types in self.node.get_topic_names_and_types()
            if self.node.count_publishers(name) and not name.startswith(own)
        }
        return missing_topics(self.selection, self.intakes, graph, floating=self.floating)

    def _is_near(self, topic: Topic) -> bool:
        """Tell whether a topic was named or lies in the node's namespace: others are of others."""
        space = self.node.get_namespace().rstrip("/")
        named = (*(self.selection.joints or ()), *(self.selection.imus or ()))
        return topic.name.startswith(f"{space}/") or topic.name in (
            *named,
            *(self.selection.wrenches or ()),
        )

    def _lacking(self, found: Iterable[Topic]) -> bool:
        named = [
            *(self.selection.joints or ()),
            *(self.selection.imus or ()),
            *(self.selection.wrenches or ()),
        ]
        bare = {topic.name.lstrip("/") for topic in found}
        has_joints = any(topic.msgtype == JOINT_STATE for topic in found)
        has_imu = any(topic.msgtype == IMU for topic in found)
        all_named = all(name.lstrip("/") in bare for name in named)
        return not (all_named and has_joints and (has_imu or not self.floating))


def resolved(node: Node, selection: TopicSelection) -> TopicSelection:
    """Return a selection with names as the graph has them, remappings included."""

    def all_of(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if names is None else tuple(map(node.resolve_topic_name, names))

    joint, imu = _remapped(node, "joint_states"), _remapped(node, "imu/data")
    joints = (joint,) if joint is not None and selection.joints is None else selection.joints
    imus = (imu,) if imu is not None and selection.imus is None else selection.imus
    return replace(
        selection,
        joints=all_of(joints),
        imus=all_of(imus),
        wrenches=all_of(selection.wrenches),
    )


def _remapped(node: Node, name: str) -> str | None:
    """Return what a name has been remapped to, None where it has not been."""
    remapped: str = node.resolve_topic_name(name)
    return None if remapped == node.resolve_topic_name(name, only_expand=True) else remapped
