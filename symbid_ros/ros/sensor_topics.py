"""Finds a robot's sensor topics on the graph and excludes those of other robots."""

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from rclpy.node import Node

from symbid_ros.errors import DataError
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.single_message import SingleMessageDecoder
from symbid_ros.messages.topics import (
    DRIVES,
    POSES,
    SelectedTopics,
    Topic,
    TopicSelection,
    TopicSelector,
    is_measured,
)
from symbid_ros.messages.types import BOOL, IMU, JOINT_STATE, WRENCH
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.message_check import known_frames
from symbid_ros.ros.raw_subscription import PolledGroup, RawSubscription, subscribe
from symbid_ros.signals.required_sensors import suggested_prefix

JOINTS, IMU_DATA = "joint_states", "imu/data"
Graph = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class RobotTopics:
    """Topics that may belong to the robot, by their fully qualified names.

    Attributes
    ----------
    selection : TopicSelection
        Topics named by parameters or remapping rules; always includes the joint states.
    remapped : frozenset of str
        Targets of remapping rules, which are candidates like the topics in the namespace.
    replaced : frozenset of str
        Sources of remapping rules, which belong to another robot.
    """

    selection: TopicSelection
    remapped: frozenset[str] = frozenset()
    replaced: frozenset[str] = frozenset()

    @property
    def named(self) -> frozenset[str]:
        """Topics that identification waits for."""
        chosen = self.selection
        bases = *chosen.poses, *chosen.drives
        sensors = chosen.joints or (), chosen.imus or (), chosen.wrenches or (), bases
        return frozenset(name for names in (*sensors, chosen.mapping.flagged) for name in names)


@dataclass
class CandidateTopic:
    """A topic that may carry data of one of the robot's sensors.

    Attributes
    ----------
    topic : Topic
    subscription : RawSubscription or None
        None once it is certain that the topic is not used.
    frame : str
        ``header.frame_id`` of the newest message examined; empty before the first.
    is_placed : bool
        Whether the model has that frame; joint states and flags of contacts need no frame.
    """

    topic: Topic
    subscription: RawSubscription | None
    frame: str = ""
    is_placed: bool = False

    def examine(self, frames: frozenset[str], mapping: SensorMapping) -> None:
        """Read messages until one has a frame of the model, and put that one back.

        The frame of a pose is that of the world, which the model does not know.
        """
        if self.topic.msgtype in (JOINT_STATE, BOOL):
            self.is_placed = True
        if self.is_placed or self.subscription is None:
            return
        messages = SingleMessageDecoder(self.topic)
        for message in self.subscription.take():
            try:
                layout, _ = messages.decode(message.payload)
            except DataError:
                continue
            self.frame = layout.text["header.frame_id"][0]
            if self.topic.msgtype in POSES or mapping.frame(self.frame) in frames:
                self.is_placed = True
                self.subscription.put_back(message)
                return


@dataclass
class SensorTopics:
    """Finds the robot's sensor topics on the graph.

    The search is complete when all named topics have been found and no new topic has appeared for
    a while. Each topic is subscribed to as soon as it appears, so that no message is lost. A topic
    of an IMU or wrench sensor is accepted when a message has a frame of the model. Of several
    topics with the same frame, those that are named, remapped or the node's own imu/data come
    first, then the shortest path. A floating base needs an IMU.
    """

    node: Node
    own: RobotTopics
    model: RobotModel
    settle: float  # time without a new topic after which the search is complete, s
    depth: int  # length of each queue, messages
    _candidates: dict[Topic, CandidateTopic] = field(default_factory=dict)
    _group: PolledGroup = field(default_factory=PolledGroup)
    _chosen: frozenset[Topic] = frozenset()
    _used: frozenset[Topic] = frozenset()
    _since: float = field(default_factory=time.monotonic)

    def find(self) -> SelectedTopics | None:
        """Update the search; return the topics if it is complete."""
        topics = [
            Topic(name, msgtype)
            for name, types in self.node.get_topic_names_and_types()
            for msgtype in types
        ]
        self._subscribe(self._wanted(topics))
        poses = [one for one in self._candidates.values() if one.topic.msgtype in POSES]
        others = [one for one in self._candidates.values() if one.topic.msgtype not in POSES]
        for candidate in others:
            # An IMU that tells when the base drives may have any frame.
            candidate.is_placed |= candidate.topic.name in self.own.selection.drives
        for candidate in poses:
            candidate.examine(frozenset(), self.own.selection.mapping)
        frames = known_frames(self.model) | {one.frame for one in poses if one.is_placed}
        for candidate in others:
            candidate.examine(frames, self.own.selection.mapping)
        chosen = self._choice()
        now = time.monotonic()
        if frozenset(chosen) != self._chosen:
            self._chosen, self._since = frozenset(chosen), now
        if now - self._since < self.settle or self._is_incomplete(chosen):
            return None
        by_type = {
            kind: tuple(topic for topic in chosen if topic.msgtype == kind)
            for kind in (JOINT_STATE, IMU, WRENCH, BOOL, *POSES)
        }
        # A joint that several topics contain is read from the first of them, in the user's order.
        order = self.own.selection.joints or ()
        return SelectedTopics(
            tuple(sorted(by_type[JOINT_STATE], key=lambda topic: order.index(topic.name))),
            tuple(one for one in by_type[IMU] if one.name not in self.own.selection.drives),
            by_type[WRENCH],
            self.own.selection.mapping,
            self.own.selection.joint_names,
            poses=tuple(
                topic
                for kind in POSES
                for topic in by_type[kind]
                if topic.name in self.own.selection.poses
            ),
            drives=tuple(
                topic
                for kind in DRIVES
                for topic in by_type[kind]
                if topic.name in self.own.selection.drives
            ),
            flags=by_type[BOOL],
        )

    def subscriptions(self, selected: SelectedTopics) -> tuple[tuple[Topic, RawSubscription], ...]:
        """Return the selected topics with their subscriptions, and close all others."""
        self._used = frozenset([*selected.all, *selected.flags])
        self.release()
        found = []
        for topic in (*selected.all, *selected.flags):
            candidate = self._candidates[topic]
            if candidate.subscription is None:
                candidate.subscription = subscribe(
                    self.node, topic.name, self.depth, self._group, topic.msgtype
                )
            if candidate.subscription is not None:
                found.append((topic, candidate.subscription))
        return tuple(found)

    def release(self) -> None:
        """Unsubscribe from unused topics, so that their queues do not fill."""
        for candidate in self._candidates.values():
            is_idle = candidate.topic not in self._used and candidate.frame
            if is_idle and candidate.subscription is not None:
                candidate.subscription.close()
                candidate.subscription = None

    @property
    def found(self) -> tuple[Topic, ...]:
        """Topics of the robot found so far."""
        return tuple(self._chosen)

    def missing(self) -> dict[str, str]:
        """Return a message for each missing topic or kind of sensor."""
        own = f"{self.node.get_fully_qualified_name()}/"
        graph = {
            name: types
            for name, types in self.node.get_topic_names_and_types()
            if self.node.count_publishers(name) and not name.startswith(own)
        }
        missing = missing_topics(
            self.own.selection, self._chosen, graph, floating=self.model.floating
        )
        for candidate in self._candidates.values():
            if candidate.frame and not candidate.is_placed:
                name, frame = candidate.topic.name, candidate.frame
                prefix = suggested_prefix(frame, self.model)
                hint = f"; give `frame_prefix` {prefix} if it is this robot's" if prefix else ""
                missing[name] = f"{name} is ignored: the model has no frame {frame!r}{hint}"
        return missing

    def _wanted(self, topics: Iterable[Topic]) -> list[Topic]:
        """Return the topics that may belong to the robot: named, remapped or in its namespace."""
        space = self.node.get_namespace().rstrip("/")
        selector = TopicSelector("live topics", self.own.selection)
        states = {
            topic.name
            for topic in topics
            if topic.msgtype == JOINT_STATE and topic.name.rsplit("/", 1)[-1] == JOINTS
        }
        # The sensors of another robot share the namespace of its joint states.
        joints = self.own.selection.joints or ()
        places = (name.removesuffix(JOINTS) for name in sorted(states - set(joints)))
        foreign = tuple(
            place
            for place in places
            if place.startswith(f"{space}/")
            and place != f"{space}/"
            and not any(name.startswith(place) for name in joints)
        )

        def is_near(topic: Topic) -> bool:
            if topic.name in self.own.named | self.own.remapped:
                return True
            is_inside = topic.name.startswith(f"{space}/") and not topic.name.startswith(foreign)
            return is_inside and topic.name not in self.own.replaced

        def is_wanted(topic: Topic) -> bool:
            is_remapped = topic.name in self.own.remapped and self._is_discovered(topic.msgtype)
            return selector.wants(topic) or is_remapped

        return [topic for topic in topics if is_wanted(topic) and is_near(topic)]

    def _is_discovered(self, msgtype: str) -> bool:
        """Return whether topics of a type are discovered, because none is named."""
        chosen = self.own.selection
        return (msgtype == IMU and chosen.imus is None) or (
            msgtype == WRENCH and chosen.wrenches is None
        )

    def _subscribe(self, topics: Iterable[Topic]) -> None:
        wanted = set(topics)
        for topic in wanted - self._candidates.keys():
            subscription = subscribe(self.node, topic.name, self.depth, self._group, topic.msgtype)
            if subscription is not None:
                self._candidates[topic] = CandidateTopic(topic, subscription)
        # A topic may turn out to belong to another robot; topics in use are kept.
        for topic in self._candidates.keys() - wanted - self._used:
            candidate = self._candidates.pop(topic)
            if candidate.subscription is not None:
                candidate.subscription.close()

    def _choice(self) -> list[Topic]:
        """Return the topics to use, one for each frame, sorted by name."""
        own_imu = self.node.resolve_topic_name(IMU_DATA)
        preferred = self.own.named | self.own.remapped | {own_imu}

        def rank(candidate: CandidateTopic) -> tuple[bool, int, str]:
            name = candidate.topic.name
            return name not in preferred, name.count("/"), name

        # Several plates may give their wrenches in the frame of the world.
        worlds = {one.frame for one in self._candidates.values() if one.topic.msgtype in POSES}
        best: dict[tuple[str, str], Topic] = {}
        for candidate in sorted(self._candidates.values(), key=rank):
            if candidate.is_placed:
                # Each of several joint state topics may contain some of the joints.
                is_placed_alone = candidate.frame and candidate.frame not in worlds
                place = candidate.frame if is_placed_alone else candidate.topic.name
                best.setdefault((candidate.topic.msgtype, place), candidate.topic)
        return sorted(best.values(), key=lambda topic: topic.name)

    def _is_incomplete(self, chosen: Iterable[Topic]) -> bool:
        names = {topic.name for topic in chosen}
        has_imu = any(topic.msgtype in (IMU, *POSES) for topic in chosen)  # or a measured pose
        return not self.own.named <= names or not (has_imu or not self.model.floating)


def resolve_topics(node: Node, selection: TopicSelection, arguments: Sequence[str]) -> RobotTopics:
    """Return the fully qualified names of a selection, with remapping rules applied.

    The rules are read from the arguments of the process: rcl applies but does not list them.
    """

    def all_of(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if names is None else tuple(map(node.resolve_topic_name, names))

    pairs = {
        (node.resolve_topic_name(name, only_expand=True), node.resolve_topic_name(name))
        for name in remapped_names(arguments)
    }
    imu = node.resolve_topic_name(IMU_DATA)
    is_remapped = imu != node.resolve_topic_name(IMU_DATA, only_expand=True)
    own = replace(
        selection,
        joints=all_of(selection.joints or (JOINTS,)),
        imus=(imu,) if is_remapped and selection.imus is None else all_of(selection.imus),
        wrenches=all_of(selection.wrenches),
        poses=all_of(selection.poses) or (),
        drives=all_of(selection.drives) or (),
        mapping=replace(
            selection.mapping,
            flagged={
                node.resolve_topic_name(name): frame
                for name, frame in selection.mapping.flagged.items()
            },
        ),
    )
    return RobotTopics(
        own, frozenset(new for _, new in pairs), frozenset(old for old, new in pairs if old != new)
    )


def remapped_names(arguments: Sequence[str]) -> list[str]:
    """Return the topic names on the left of ``-r old:=new`` among a process's arguments."""
    rules = [rule for flag, rule in pairwise(arguments) if flag in ("-r", "--remap")]
    names = [rule.partition(":=")[0] for rule in rules]
    # A rule may begin with the name of the node to which it applies.
    return [name for name in (each.split(":")[-1] for each in names) if not name.startswith("__")]


def missing_topics(
    selection: TopicSelection, found: Collection[Topic], graph: Graph, *, floating: bool
) -> dict[str, str]:
    """Return a message for each missing topic or kind of sensor, naming the parameter to correct.

    The graph holds the types of each topic that has a publisher. A floating base needs an IMU.
    """
    missing: dict[str, str] = {}
    names = {topic.name for topic in found}
    for parameter, msgtypes, wanted in (
        ("joint_topic", (JOINT_STATE,), selection.joints),
        ("imu_topic", (IMU,), selection.imus),
        ("wrench_topic", (WRENCH,), selection.wrenches),
        ("contact_flag", (BOOL,), tuple(selection.mapping.flagged)),
        ("pose_topic", POSES, selection.poses),
        ("wheel_topic", DRIVES, selection.drives),
    ):
        for name in wanted or ():
            if f"/{name.lstrip('/')}" not in names:
                types = graph.get(name, ())
                kind = next((one for one in msgtypes if one in types), msgtypes[0])
                missing[name] = _describe_missing(name, kind, parameter, graph)
    kinds = {topic.msgtype for topic in found}
    if selection.joints is None and JOINT_STATE not in kinds:
        missing["joint states"] = (
            f"waiting for a topic joint_states of type {JOINT_STATE} in this node's namespace; "
            f"{_others(JOINT_STATE, graph)}; start the robot's driver, or give `joint_topic`"
        )
    if floating and selection.imus is None and kinds.isdisjoint((IMU, *POSES)):
        missing["IMU"] = (
            f"waiting for a topic of type {IMU} in this node's namespace, which a floating base "
            f"needs; {_others(IMU, graph)}; start the IMU's driver, or give `imu_topic`, or "
            "`base` fixed"
        )
    return missing


def _describe_missing(name: str, msgtype: str, parameter: str, graph: Graph) -> str:
    types = graph.get(name, ())
    if types and msgtype not in types:
        return (
            f"`{parameter}`: topic {name} is of type {', '.join(types)}, not {msgtype}; "
            "name another topic"
        )
    if types:
        return f"waiting for the first message on topic {name} (`{parameter}`); check its driver"
    return (
        f"waiting for topic {name} (`{parameter}`), which has no publisher; "
        f"{_others(msgtype, graph)}; start its driver or correct `{parameter}`"
    )


def _others(msgtype: str, graph: Graph) -> str:
    names = sorted(n for n, types in graph.items() if msgtype in types and is_measured(n))
    return f"topics of that type: {', '.join(names) or 'none'}"
