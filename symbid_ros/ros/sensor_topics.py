"""A robot's sensor topics on the graph: found, told apart from those of other robots, and kept."""

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from rclpy.node import Node

from symbid_ros.errors import DataError
from symbid_ros.messages.single_message import SingleMessageDecoder
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection, TopicSelector
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.message_check import known_frames
from symbid_ros.ros.raw_subscription import PolledGroup, RawSubscription, subscribe
from symbid_ros.signals.alignment import suggested_prefix

JOINTS, IMU_DATA = "joint_states", "imu/data"
Graph = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class RobotTopics:
    """Which topics may be the robot's, as the graph names them.

    Attributes
    ----------
    selection : TopicSelection
        Topics named by parameters or remapping; the joint states always are.
    remapped : frozenset of str
        Targets of remapped sensor names: candidates like those in the namespace.
    replaced : frozenset of str
        The names that were remapped: whoever publishes there is another.
    """

    selection: TopicSelection
    remapped: frozenset[str] = frozenset()
    replaced: frozenset[str] = frozenset()

    @property
    def named(self) -> frozenset[str]:
        """Topics that must turn up."""
        chosen = self.selection
        return frozenset([*(chosen.joints or ()), *(chosen.imus or ()), *(chosen.wrenches or ())])


@dataclass
class CandidateTopic:
    """A topic that may be a sensor's of the robot.

    Attributes
    ----------
    topic : Topic
    subscription : RawSubscription or None
        None once it is known that the topic is not used.
    frame : str
        ``header.frame_id`` of the newest message looked at; empty before one came.
    is_placed : bool
        Whether the model knows that frame. Joint states need none.
    """

    topic: Topic
    subscription: RawSubscription | None
    frame: str = ""
    is_placed: bool = False

    def look(self, frames: frozenset[str], prefix: str) -> None:
        """Look at messages until one is of a frame that the model knows; leave that one.

        Parameters
        ----------
        frames : frozenset of str
            The model's.
        prefix : str
            What the sensors' frames begin with and the model's do not.
        """
        if self.topic.msgtype == JOINT_STATE:
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
            if self.frame.removeprefix(prefix) in frames:
                self.is_placed = True
                self.subscription.put_back(message)
                return


@dataclass
class SensorTopics:
    """Waits until the graph shows all topics that are wanted, and no more turn up.

    Each is subscribed to at first sight, so that nothing is lost meanwhile. An IMU or a wrench
    counts once a message shows that its frame is the model's; of several topics with one frame,
    the node's own name wins, then the shortest path.

    Attributes
    ----------
    node : Node
    own : RobotTopics
        Which topics are wanted.
    model : RobotModel
        Whose frames the sensors have; a floating base needs an IMU.
    settle : float
        For how long nothing more must turn up, s.
    depth : int
        Messages that each may keep waiting.
    """

    node: Node
    own: RobotTopics
    model: RobotModel
    settle: float
    depth: int
    _candidates: dict[Topic, CandidateTopic] = field(default_factory=dict)
    _group: PolledGroup = field(default_factory=PolledGroup)
    _chosen: frozenset[Topic] = frozenset()
    _used: frozenset[Topic] = frozenset()
    _since: float = field(default_factory=time.monotonic)

    def look(self) -> SelectedTopics | None:
        """Look at the graph once; return the topics when they are complete."""
        topics = [
            Topic(name, msgtype)
            for name, types in self.node.get_topic_names_and_types()
            for msgtype in types
        ]
        self._subscribe(self._wanted(topics))
        frames = known_frames(self.model)
        for candidate in self._candidates.values():
            candidate.look(frames, self.own.selection.frame_prefix)
        chosen = self._choice()
        now = time.monotonic()
        if frozenset(chosen) != self._chosen:
            self._chosen, self._since = frozenset(chosen), now
        if now - self._since < self.settle or self._lacking(chosen):
            return None
        by_type = {
            kind: tuple(topic for topic in chosen if topic.msgtype == kind)
            for kind in (JOINT_STATE, IMU, WRENCH)
        }
        # A joint that several topics name is taken from the first of them, in the user's order.
        order = self.own.selection.joints or ()
        return SelectedTopics(
            tuple(sorted(by_type[JOINT_STATE], key=lambda topic: order.index(topic.name))),
            by_type[IMU],
            by_type[WRENCH],
            self.own.selection.frame_prefix,
            self.own.selection.joint_names,
        )

    def subscriptions(self, selected: SelectedTopics) -> tuple[tuple[Topic, RawSubscription], ...]:
        """Return the selected topics with their subscriptions, and let go of all others."""
        self._used = frozenset(selected.all)
        self.release()
        found = []
        for topic in selected.all:
            candidate = self._candidates[topic]
            if candidate.subscription is None:
                candidate.subscription = subscribe(
                    self.node, topic.name, self.depth, self._group, topic.msgtype
                )
            if candidate.subscription is not None:
                found.append((topic, candidate.subscription))
        return tuple(found)

    def release(self) -> None:
        """Unsubscribe from topics that are not used, so that their queues do not fill."""
        for candidate in self._candidates.values():
            is_idle = candidate.topic not in self._used and candidate.frame
            if is_idle and candidate.subscription is not None:
                candidate.subscription.close()
                candidate.subscription = None

    @property
    def found(self) -> tuple[Topic, ...]:
        """The robot's topics as far as they have turned up."""
        return tuple(self._chosen)

    def missing(self) -> dict[str, str]:
        """Return what is still waited for, and why, by topic or kind of sensor."""
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
                hint = f"; give -p frame_prefix:={prefix} if it is this robot's" if prefix else ""
                missing[name] = f"{name} is not used: the model has no frame {frame!r}{hint}"
        return missing

    def _wanted(self, topics: Iterable[Topic]) -> list[Topic]:
        """Return the topics that may be the robot's: named, remapped, or in its namespace."""
        space = self.node.get_namespace().rstrip("/")
        selector = TopicSelector("live topics", self.own.selection)
        states = {
            topic.name
            for topic in topics
            if topic.msgtype == JOINT_STATE and topic.name.rsplit("/", 1)[-1] == JOINTS
        }
        # Another robot's sensors lie beside its joint states, if not right where ours do.
        own_joints = self.own.selection.joints or ()
        places = (name.removesuffix(JOINTS) for name in sorted(states - set(own_joints)))
        foreign = tuple(
            place
            for place in places
            if place.startswith(f"{space}/")
            and place != f"{space}/"
            and not any(name.startswith(place) for name in own_joints)
        )

        def is_near(topic: Topic) -> bool:
            if topic.name in self.own.named | self.own.remapped:
                return True
            is_inside = topic.name.startswith(f"{space}/") and not topic.name.startswith(foreign)
            return is_inside and topic.name not in self.own.replaced

        def is_wanted(topic: Topic) -> bool:
            is_remapped = topic.name in self.own.remapped and self._is_open(topic.msgtype)
            return selector.wants(topic) or is_remapped

        return [topic for topic in topics if is_wanted(topic) and is_near(topic)]

    def _is_open(self, msgtype: str) -> bool:
        """Tell whether topics of a type are to be found, none having been named."""
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
        # Taken for the robot's until its owner turned up; what is in use stays.
        for topic in self._candidates.keys() - wanted - self._used:
            candidate = self._candidates.pop(topic)
            if candidate.subscription is not None:
                candidate.subscription.close()

    def _choice(self) -> list[Topic]:
        """Return the topics to use, the best of each frame, in the order of their names."""
        own_imu = self.node.resolve_topic_name(IMU_DATA)
        preferred = self.own.named | self.own.remapped | {own_imu}

        def rank(candidate: CandidateTopic) -> tuple[bool, int, str]:
            name = candidate.topic.name
            return name not in preferred, name.count("/"), name

        best: dict[tuple[str, str], Topic] = {}
        for candidate in sorted(self._candidates.values(), key=rank):
            if candidate.is_placed:
                # Several topics of joint states may each hold some of the joints.
                place = candidate.frame or candidate.topic.name
                best.setdefault((candidate.topic.msgtype, place), candidate.topic)
        return sorted(best.values(), key=lambda topic: topic.name)

    def _lacking(self, chosen: Iterable[Topic]) -> bool:
        names = {topic.name for topic in chosen}
        has_imu = any(topic.msgtype == IMU for topic in chosen)
        return not self.own.named <= names or not (has_imu or not self.model.floating)


def resolve_topics(node: Node, selection: TopicSelection, arguments: Sequence[str]) -> RobotTopics:
    """Return the names of a selection as the graph has them, remappings included.

    Parameters
    ----------
    node : Node
    selection : TopicSelection
        As the parameters ask.
    arguments : sequence of str
        Of the process: rcl applies the remappings in them, but does not list them.
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
    )
    return RobotTopics(
        own, frozenset(new for _, new in pairs), frozenset(old for old, new in pairs if old != new)
    )


def remapped_names(arguments: Sequence[str]) -> list[str]:
    """Return the topic names on the left of ``-r old:=new`` among a process's arguments."""
    rules = [rule for flag, rule in pairwise(arguments) if flag in ("-r", "--remap")]
    names = [rule.partition(":=")[0] for rule in rules]
    # A rule may begin with the name of the node that it is for.
    return [name for name in (each.split(":")[-1] for each in names) if not name.startswith("__")]


def missing_topics(
    selection: TopicSelection, found: Collection[Topic], graph: Graph, *, floating: bool
) -> dict[str, str]:
    """Return a message for each topic that is missing, by topic or by kind.

    Parameters
    ----------
    selection : TopicSelection
        Which topics are wanted, with names as the graph has them.
    found : collection of Topic
        Topics subscribed to.
    graph : mapping of str to sequence of str
        Types of each topic that has a publisher.
    floating : bool
        Whether the robot's base floats, so that it needs an IMU.
    """
    missing: dict[str, str] = {}
    names = {topic.name for topic in found}
    for parameter, msgtype, wanted in (
        ("joint_topic", JOINT_STATE, selection.joints),
        ("imu_topics", IMU, selection.imus),
        ("wrench_topics", WRENCH, selection.wrenches),
    ):
        for name in wanted or ():
            if f"/{name.lstrip('/')}" not in names:
                missing[name] = _named(name, msgtype, parameter, graph)
    kinds = {topic.msgtype for topic in found}
    if selection.joints is None and JOINT_STATE not in kinds:
        missing["joint states"] = (
            f"waiting for a topic joint_states of type {JOINT_STATE} in this node's namespace; "
            f"{_others(JOINT_STATE, graph)}; start the robot's driver, or name its topic in the "
            "parameter joint_topic"
        )
    if floating and selection.imus is None and IMU not in kinds:
        missing["IMU"] = (
            f"waiting for a topic of type {IMU} in this node's namespace, which a floating base "
            f"needs; {_others(IMU, graph)}; start the IMU's driver, name its topic in the "
            "parameter imu_topics, or give base:=fixed"
        )
    return missing


def _named(name: str, msgtype: str, parameter: str, graph: Graph) -> str:
    types = graph.get(name, ())
    if types and msgtype not in types:
        return (
            f"parameter {parameter}: topic {name} is of type {', '.join(types)}, not {msgtype}; "
            "name another topic"
        )
    if types:
        return (
            f"waiting for the first message on topic {name} (parameter {parameter}); check its "
            "driver"
        )
    return (
        f"waiting for topic {name} (parameter {parameter}), which nobody publishes; "
        f"{_others(msgtype, graph)}; start its driver or correct the parameter"
    )


def _others(msgtype: str, graph: Graph) -> str:
    names = sorted(name for name, types in graph.items() if msgtype in types)
    return f"topics of that type: {', '.join(names) or 'none'}"
