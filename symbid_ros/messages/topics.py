"""Which topics of a bag feed an identification."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from symbid_ros.errors import BagError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

TRUTH = "ground_truth"
UNLIMITED = {"sec": 9223372036, "nsec": 854775807}
ENCODED = " encoded as "  # between the name of a type and what its messages are instead


@dataclass(frozen=True)
class Topic:
    """A topic: name as recorded or resolved, and message type."""

    name: str
    msgtype: str


@dataclass(frozen=True)
class OfferedQos:
    """What a publisher offers, in rosbag2's words."""

    depth: int = 10
    history: str = "keep_last"
    reliability: str = "reliable"
    durability: str = "volatile"

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``offered_qos_profiles``; unnamed policies are unlimited."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(UNLIMITED),
            "lifespan": dict(UNLIMITED),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(UNLIMITED),
            "avoid_ros_namespace_conventions": False,
        }


@dataclass(frozen=True)
class TopicSelection:
    """Topics to read; a leading slash may be left out everywhere.

    Attributes
    ----------
    joints : tuple of str or None
        JointState topics, whose joints are merged by stamp; None takes the only one named
        ``joint_states`` in any namespace.
    imus : tuple of str or None
        Imu topics; None takes all.
    wrenches : tuple of str or None
        WrenchStamped topics; None takes all named ``wrench`` in any namespace.
    frame_prefix : str
        What sensors' frames begin with and the model's do not, such as ``robot1/``.
    joint_names : tuple of str
        Joints that must be read, where known: messages that name none of them are ignored.
    """

    joints: tuple[str, ...] | None = None
    imus: tuple[str, ...] | None = None
    wrenches: tuple[str, ...] | None = None
    frame_prefix: str = ""
    joint_names: tuple[str, ...] = ()

    @classmethod
    def of(cls, options: LogOptions) -> "TopicSelection":
        """Return the selection that options ask for."""
        return cls(
            joints=options.joint_topic or None,
            imus=options.imu_topic or None,
            wrenches=options.wrench_topic or None,
            frame_prefix=options.frame_prefix,
        )

    def __post_init__(self) -> None:
        for name in (*(self.joints or ()), *(self.imus or ()), *(self.wrenches or ())):
            if _is_truth(name):
                raise BagError(
                    f"topic {name}: the ground truth is never identified from; name a sensor's"
                )


@dataclass(frozen=True)
class SelectedTopics:
    """The topics of one recording that a selection takes.

    Attributes
    ----------
    joints, imus, wrenches : tuple of Topic
        By sensor; one topic of joint states at least.
    frame_prefix, joint_names
        As in `TopicSelection`.
    """

    joints: tuple[Topic, ...]
    imus: tuple[Topic, ...]
    wrenches: tuple[Topic, ...]
    frame_prefix: str = ""
    joint_names: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[Topic, ...]:
        """All of them, joint states first."""
        return (*self.joints, *self.imus, *self.wrenches)

    @property
    def clock(self) -> Topic:
        """The topic of joint states whose stamps tell how far a recording has come."""
        return self.joints[0]


@dataclass
class TopicSelector:
    """Applies a selection while a recording is being read.

    Attributes
    ----------
    source : str
        Name of the bag, for messages to the user.
    selection : TopicSelection
    counts : dict of Topic to int
        Messages by topic; whoever reads the bag keeps it.
    """

    source: str
    selection: TopicSelection
    counts: dict[Topic, int] = field(default_factory=dict)

    def wants(self, topic: Topic) -> bool:
        """Tell whether messages of a topic may be needed."""
        return (
            self._is(topic, JOINT_STATE, self.selection.joints, "joint_states")
            or self._is(topic, IMU, self.selection.imus, None)
            or self._is(topic, WRENCH, self.selection.wrenches, "wrench")
        )

    def selected(self) -> SelectedTopics:
        """Return the selected topics of a recording read to its end."""
        joints = self._all(JOINT_STATE, self.selection.joints, "joint_states")
        if not joints:
            raise BagError(
                f"{self.source}: no {JOINT_STATE} topic named joint_states, it holds "
                f"{self._listing()}; {self._remedy()}"
            )
        if len(joints) > 1 and self.selection.joints is None:
            raise BagError(
                f"{self.source}: several topics of joint states, "
                f"{', '.join(topic.name for topic in joints)}; name the one to use, or all whose "
                "joints are to be merged"
            )
        chosen = SelectedTopics(
            joints,
            self._all(IMU, self.selection.imus, None),
            self._all(WRENCH, self.selection.wrenches, "wrench"),
            self.selection.frame_prefix,
            self.selection.joint_names,
        )
        for topic in chosen.all:
            if not self.counts[topic]:
                raise BagError(
                    f"{self.source}: no message on {topic.name}; record it again or leave the "
                    "topic out"
                )
        return chosen

    def _is(
        self, topic: Topic, msgtype: str, names: tuple[str, ...] | None, ending: str | None
    ) -> bool:
        if names is not None:
            return topic.msgtype == msgtype and _bare(topic.name) in map(_bare, names)
        is_named = ending is None or topic.name.rsplit("/", 1)[-1] == ending
        return topic.msgtype == msgtype and is_named and not _is_truth(topic.name)

    def _all(
        self, msgtype: str, names: tuple[str, ...] | None, ending: str | None
    ) -> tuple[Topic, ...]:
        if names is None:
            found = [topic for topic in self.counts if self._is(topic, msgtype, None, ending)]
            return tuple(sorted(found, key=lambda topic: topic.name))
        return tuple(self._named(name, msgtype) for name in names)

    def _named(self, name: str, msgtype: str) -> Topic:
        others = [topic for topic in self.counts if _bare(topic.name) == _bare(name)]
        if not others:
            raise BagError(
                f"{self.source}: no topic {name}, it holds {self._listing()}; name one of these"
            )
        for topic in others:
            if topic.msgtype == msgtype:
                return topic
        raise BagError(
            f"{self.source}: topic {name} is of type {others[0].msgtype}, not {msgtype}; "
            "name another topic"
        )

    def _remedy(self) -> str:
        if any(topic.msgtype == JOINT_STATE for topic in self.counts):
            return "name the topic of the joint states"
        if any(ENCODED in topic.msgtype for topic in self.counts):
            return "convert its messages to ROS 2's, in CDR"
        return "record the joint states as well"

    def _listing(self) -> str:
        return describe_topics(self.counts)


def describe_topics(topics: Iterable[Topic]) -> str:
    """Return topics and types in one line."""
    names = sorted(f"{topic.name} ({topic.msgtype or 'no type'})" for topic in topics)
    return ", ".join(names) or "no topic at all"


def _bare(name: str) -> str:
    return name.lstrip("/")


def _is_truth(name: str) -> bool:
    return TRUTH in name.split("/")
