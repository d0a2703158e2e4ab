"""Topics of a robot, and the selection of those that an identification reads."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from symbid_ros.errors import BagError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.name_check import ModelNames
from symbid_ros.messages.sensor_mapping import SAME, HeldJoints, SensorMapping
from symbid_ros.messages.types import BOOL, IMU, JOINT_STATE, ODOMETRY, POSE, WRENCH
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.wrapped_angles import AngleUnwrapper

TRUTH = "ground_truth"
RESIDUALS = "effort_residual", "wrench_residual"  # last parts of an identifier's own topics
UNLIMITED = {"sec": 9223372036, "nsec": 854775807}
POSES = ODOMETRY, POSE
DRIVES = ODOMETRY, IMU
TOPIC_OPTIONS = {JOINT_STATE: "joint_topic", IMU: "imu_topic", WRENCH: "wrench_topic"}
ENCODED = " encoded as "  # between a type's name and an encoding other than CDR


def topic_token(link: str) -> str:
    """Return a link's name as a valid part of a topic name."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", link)
    return f"_{token}" if token[:1].isdigit() else token


@dataclass(frozen=True)
class Topic:
    """A topic: its name, as recorded or resolved, and its message type."""

    name: str
    msgtype: str

    def __hash__(self) -> int:
        # Live messages look up their topic often, and a string remembers its hash.
        return hash(self.name)


@dataclass(frozen=True)
class OfferedQos:
    """Quality of service that a publisher offers, in the terms of rosbag2."""

    depth: int = 10
    history: str = "keep_last"
    reliability: str = "reliable"
    durability: str = "volatile"

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``offered_qos_profiles``; other policies are unlimited."""
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
    """Topics to read; a leading slash may be omitted in each name.

    Attributes
    ----------
    joints : tuple of str or None
        JointState topics, whose joints are merged by stamp; None selects the only one named
        ``joint_states`` in any namespace.
    imus : tuple of str or None
        Imu topics; None selects all.
    wrenches : tuple of str or None
        WrenchStamped topics; None selects all named ``wrench`` in any namespace.
    mapping : SensorMapping
        Names, units and signs of the log.
    joint_names : tuple of str
        Joints of the model, if known: messages that name none of them are ignored.
    linear_joints : tuple of str
        Its prismatic joints, whose positions are lengths instead of angles.
    model : ModelNames or None
        Names of the model, if known.
    poses : tuple of str
        Odometry and PoseStamped topics of tracked frames.
    drives : tuple of str
        Odometry or Imu topics of wheeled bases.
    logged : set of str
        Messages about the log so far. Each is logged once, however often the log is read.
    """

    joints: tuple[str, ...] | None = None
    imus: tuple[str, ...] | None = None
    wrenches: tuple[str, ...] | None = None
    mapping: SensorMapping = SAME
    joint_names: tuple[str, ...] = ()
    poses: tuple[str, ...] = ()
    drives: tuple[str, ...] = ()
    linear_joints: tuple[str, ...] = ()
    model: ModelNames | None = None
    logged: set[str] = field(default_factory=set, repr=False, compare=False)

    @classmethod
    def of(cls, options: LogOptions) -> "TopicSelection":
        """Return the selection that options ask for."""
        return cls(
            joints=options.joint_topic or None,
            imus=options.imu_topic or None,
            wrenches=options.wrench_topic or None,
            mapping=SensorMapping.of(options),
            poses=options.pose_topic,
            drives=options.wheel_topic,
        )

    def of_model(self, model: RobotModel) -> "TopicSelection":
        """Return the selection for the joints of a model."""
        return replace(
            self,
            joint_names=model.measured_joint_names,
            linear_joints=model.prismatic_joint_names,
            model=ModelNames.of(model),
        )

    def __post_init__(self) -> None:
        named = self.joints or (), self.imus or (), self.wrenches or (), self.poses
        for name in (each for names in named for each in names):
            if is_truth(name):
                raise BagError(
                    f"topic {name}: ground truth cannot be used for identification; name the topic "
                    "of a sensor",
                    "E214",
                )


@dataclass(frozen=True)
class SelectedTopics:
    """The selected topics of one recording.

    Attributes
    ----------
    joints, imus, wrenches, poses, drives : tuple of Topic
        Topics by sensor type; at least one has joint states.
    flags : tuple of Topic
        Topics that tell whether a contact touches anything. Their messages have no stamp.
    mapping, joint_names, linear_joints, logged
        As in `TopicSelection`.
    is_live : bool
        Whether the topics are those of a running robot.
    """

    joints: tuple[Topic, ...]
    imus: tuple[Topic, ...]
    wrenches: tuple[Topic, ...]
    mapping: SensorMapping = SAME
    joint_names: tuple[str, ...] = ()
    is_live: bool = False
    poses: tuple[Topic, ...] = ()
    flags: tuple[Topic, ...] = ()
    drives: tuple[Topic, ...] = ()
    linear_joints: tuple[str, ...] = ()
    logged: set[str] = field(default_factory=set, repr=False, compare=False)

    @cached_property
    def recorded_joints(self) -> frozenset[str]:
        """Names that the log uses for the model's joints; empty if these are unknown."""
        return self.mapping.recorded_joints(self.joint_names)

    @cached_property
    def held_joints(self) -> HeldJoints:
        """Joints of the model that this recording lacks."""
        return HeldJoints(self.joint_names, self.mapping.held, self.is_live, self.logged)

    @cached_property
    def unwrapper(self) -> AngleUnwrapper:
        """Unwraps the joints' angles in this recording, one slice after the other."""
        return AngleUnwrapper(self.mapping.recorded_joints(self.linear_joints), self.logged)

    @property
    def all(self) -> tuple[Topic, ...]:
        """All topics with stamps, joint states first."""
        return (*self.joints, *self.imus, *self.wrenches, *self.poses, *self.drives)

    def takes_any_frame(self, topic: Topic) -> bool:
        """Return whether messages of a topic may have a frame that the model lacks.

        Poses and wrenches beside them may be given in a frame of the world. An IMU that tells when
        the base drives needs no frame.
        """
        is_in_world = topic in self.poses or (bool(self.poses) and topic in self.wrenches)
        return is_in_world or topic in self.drives

    def flagged_frame(self, topic: Topic) -> str:
        """Return the frame of the contact that a topic of flags is about."""
        frames = {_bare(name): frame for name, frame in self.mapping.flagged.items()}
        return frames[_bare(topic.name)]

    @property
    def clock(self) -> Topic:
        """The topic of joint states whose stamps measure progress."""
        return self.joints[0]


@dataclass
class TopicSelector:
    """Applies a selection to the topics of a recording.

    Attributes
    ----------
    source : str
        Name of the bag, for error messages.
    selection : TopicSelection
    counts : dict of Topic to int
        Messages by topic; the reader of the bag updates it.
    """

    source: str
    selection: TopicSelection
    counts: dict[Topic, int] = field(default_factory=dict)

    def wants(self, topic: Topic) -> bool:
        """Return whether the selection may include a topic."""
        return (
            self._matches(topic, JOINT_STATE, self.selection.joints, "joint_states")
            or self._matches(topic, IMU, self.selection.imus, None)
            or self._matches(topic, WRENCH, self.selection.wrenches, "wrench")
            or any(self._matches(topic, kind, self.selection.poses, None) for kind in POSES)
            or any(self._matches(topic, kind, self.selection.drives, None) for kind in DRIVES)
            or self._matches(topic, BOOL, tuple(self.selection.mapping.flagged), None)
        )

    def select(self) -> SelectedTopics:
        """Return the selected topics, once all messages are counted.

        Raises
        ------
        BagError
            When a topic is missing or empty, has another type, or is not unique.
        """
        joints = self._find(JOINT_STATE, self.selection.joints, "joint_states")
        if not joints:
            raise BagError(
                f"{self.source}: no {JOINT_STATE} topic named joint_states, it holds "
                f"{describe_topics(self.counts)}; {self._remedy()}",
                "E210",
            )
        if len(joints) > 1 and self.selection.joints is None:
            raise BagError(
                f"{self.source}: several topics of joint states, "
                f"{', '.join(topic.name for topic in joints)}; name the one to use, or all whose "
                "joints are to be merged, by `joint_topic`, or write "
                f"{robot_file_line('joint_topic', *(topic.name for topic in joints))}",
                "E212",
            )
        drives = self._find_named("wheel_topic", self.selection.drives, DRIVES)
        imus = self._find(IMU, self.selection.imus, None)
        chosen = SelectedTopics(
            joints,
            tuple(topic for topic in imus if topic not in drives),
            self._find(WRENCH, self.selection.wrenches, "wrench"),
            self.selection.mapping,
            self.selection.joint_names,
            poses=self._find_named("pose_topic", self.selection.poses, POSES),
            drives=drives,
            linear_joints=self.selection.linear_joints,
            flags=self._find_named("contact_flag", self.selection.mapping.flagged, (BOOL,)),
            logged=self.selection.logged,
        )
        for topic in (*chosen.all, *chosen.flags):
            if not self.counts[topic]:
                raise BagError(
                    f"{self.source}: no message on {topic.name}; record it again or leave the "
                    "topic out",
                    "E213",
                )
        return chosen

    def _matches(
        self, topic: Topic, msgtype: str, names: tuple[str, ...] | None, ending: str | None
    ) -> bool:
        if names is not None:
            return topic.msgtype == msgtype and _bare(topic.name) in map(_bare, names)
        is_named = ending is None or topic.name.rsplit("/", 1)[-1] == ending
        return topic.msgtype == msgtype and is_named and is_measured(topic.name)

    def _find(
        self, msgtype: str, names: tuple[str, ...] | None, ending: str | None
    ) -> tuple[Topic, ...]:
        if names is None:
            found = [topic for topic in self.counts if self._matches(topic, msgtype, None, ending)]
            return tuple(sorted(found, key=lambda topic: topic.name))
        return self._find_named(TOPIC_OPTIONS[msgtype], names, (msgtype,))

    def _find_named(
        self, option: str, names: Iterable[str], msgtypes: Sequence[str]
    ) -> tuple[Topic, ...]:
        """Return the topics that an option names, each of one of some types."""
        return tuple(self._named(option, name, msgtypes) for name in names)

    def _named(self, option: str, name: str, msgtypes: Sequence[str]) -> Topic:
        others = [topic for topic in self.counts if _bare(topic.name) == _bare(name)]
        if not others:
            raise BagError(
                f"{self.source}: no topic {name}, it holds {describe_topics(self.counts)}; "
                f"{self._advice(option, msgtypes)}",
                "E210",
            )
        for topic in others:
            if topic.msgtype in msgtypes:
                return topic
        raise BagError(
            f"{self.source}: topic {name} is of type {others[0].msgtype}, not "
            f"{' or '.join(msgtypes)}; {self._advice(option, msgtypes)}",
            "E211",
        )

    def _advice(self, option: str, msgtypes: Sequence[str]) -> str:
        """Return which topics an option may name, spelled where the option was given."""
        usable = sorted(
            topic.name
            for topic in self.counts
            if topic.msgtype in msgtypes and is_measured(topic.name)
        )
        if not usable:
            return f"record one of type {' or '.join(msgtypes)}, or leave `{option}` out"
        suitable = f"{usable[0]}:=FRAME" if option == "contact_flag" else usable[0]
        if option in self.selection.mapping.of_robot:
            line = robot_file_line(option, suitable)
            return f"name one of that type by `{option}`, or write {line}"
        return f"name one of that type, such as `{option}` {suitable}"

    def _remedy(self) -> str:
        names = sorted(
            topic.name
            for topic in self.counts
            if topic.msgtype == JOINT_STATE and is_measured(topic.name)
        )
        if names:
            return (
                "name the topic of the joint states by `joint_topic`, or write "
                f"{robot_file_line('joint_topic', names[0])}"
            )
        if any(ENCODED in topic.msgtype for topic in self.counts):
            return "convert its messages to ROS 2 messages in CDR"
        return "record the joint states as well"


def describe_topics(topics: Iterable[Topic]) -> str:
    """List topics and their types in one line."""
    names = sorted(f"{topic.name} ({topic.msgtype or 'no type'})" for topic in topics)
    return ", ".join(names) or "no topic at all"


def _bare(name: str) -> str:
    return name.lstrip("/")


def is_truth(name: str) -> bool:
    """Return whether a topic holds the ground truth of a simulation."""
    return TRUTH in name.split("/")


def is_measured(name: str) -> bool:
    """Return whether a topic may be a sensor's: neither ground truth nor an estimate's residual."""
    return not is_truth(name) and name.rsplit("/", 1)[-1] not in RESIDUALS
