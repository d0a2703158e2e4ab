"""Finds out how a log of a robot is to be read.

Names of topics, joints and sensors are matched first. Then the log itself tells wrong signs and
units.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from symbid_ros.bags import bag_log, count_messages, join_names
from symbid_ros.choices import Base
from symbid_ros.errors import BagError, DataError, ModelError, SymbidError
from symbid_ros.identification.conventions.assumed_contacts import assumed_contacts, leg_ends
from symbid_ros.identification.log_reading import MINUTE
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.topics import Topic, TopicSelection, describe_topics, is_measured
from symbid_ros.messages.types import BOOL, IMU, JOINT_STATE, ODOMETRY, POSE, WRENCH
from symbid_ros.model.load import is_mjcf, load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.force_plates import PlateContacts, find_plate_contacts
from symbid_ros.offline.log_corrections import LogCorrections
from symbid_ros.offline.name_matching import joints_by_robot, match_names, most_similar
from symbid_ros.offline.robot_setup_file import RobotSetup
from symbid_ros.options import robot_file_line, spelled
from symbid_ros.signals.required_sensors import suggested_prefix
from symbid_ros.signals.streams import JointStream, Streams
from symbid_ros.signals.wheels import rolling_wheels, wheel_advice

SPAN = 4 * 10**9  # ns of a log that show its names
# Words of a topic of contact flags, one of which its name must contain.
CONTACT_WORDS = re.compile(r"contact|touch|stance|ground", re.IGNORECASE)
COMMAND_WORDS = "command", "cmd", "desired", "setpoint", "target"  # in names of topics
FEWEST_LEGS = 2  # of a robot whose base hardly ever is fixed


def inspect_robot(model: Path, bags: Sequence[Path], base: Base = "auto") -> RobotSetup:
    """Find out how the log in bags is to be read for a model.

    Parameters
    ----------
    model : Path
        URDF or MJCF.
    bags : sequence of Path
        Bags of one recording.
    base : {"auto", "floating", "fixed"}
        Whether the base of a URDF may move; auto: as the model says, and fixed with neither an IMU
        nor a PoseStamped.

    Raises
    ------
    ModelError, BagError, DataError
        When the model or the bags cannot be read, or the log has no joint states.
    """
    topics = {
        topic: count
        for topic, count in count_messages(bags).items()
        if count and is_measured(topic.name)
    }
    robot = load_model(model, base)
    has_motion = any(topic.msgtype in (IMU, POSE) for topic in topics)
    has_unknown_base = base == "auto" and robot.floating and not has_motion
    if has_unknown_base and not is_mjcf(model):  # whose base is free if the file says so
        robot = load_model(model, "fixed")
    robot = bag_log(bags).applied_to(robot)
    setup = RobotSetup(model.absolute(), "floating" if robot.floating else "fixed")
    if has_unknown_base and len(legs := leg_ends(robot)) >= FEWEST_LEGS:
        setup.has_open_question = True
        setup.note(
            "base",
            f"CHECK: the model has legs ({', '.join(legs)}), but the log has no IMU and no pose of "
            "the base. If the base moved, record one of them. If not, give --base fixed, which "
            "also looks for wrong signs and units.",
        )
    matcher = _TopicMatcher(tuple(bags), robot, tuple(topics), setup)
    matcher.match_joints()
    if robot.floating:
        matcher.match_sensors(IMU, "imu_topic")
        matcher.find_poses()
    matcher.match_sensors(WRENCH, "wrench_topic")
    if robot.floating:
        matcher.find_plates()
        matcher.find_contacts()
    else:
        matcher.find_drives()
    LogCorrections(tuple(bags), robot, setup, matcher.frames).find()
    return setup


def expand_xacro(file: Path) -> str:
    """Return the URDF that a xacro file describes. xacro evaluates Python expressions in the file.

    Raises
    ------
    ModelError
        When xacro is not installed, or the file is invalid. ``$(find package)`` needs the package
        in a sourced ROS workspace.
    """
    try:
        import xacro  # noqa: PLC0415 - an optional library
    except ModuleNotFoundError:
        raise ModelError(
            f"{file}: needs xacro, which is not installed; run `pip install xacro`, or give the "
            "URDF",
            "E119",
        ) from None
    try:
        document = xacro.process_file(str(file))
    except Exception as error:  # expressions in the file may raise anything
        # xacro's own text contains that of its cause twice.
        cause = getattr(error, "exc", None) or error
        reason = " ".join(str(cause).split()) or type(cause).__name__
        raise ModelError(
            f"{file}: xacro: {reason}; correct the file, and for $(find PACKAGE) source the "
            "workspace of the package",
            "E119",
        ) from None
    return str(document.toprettyxml(indent="  "))


@dataclass
class _TopicMatcher:
    """Fills a setup from the topics of one recording."""

    bags: tuple[Path, ...]
    robot: RobotModel
    topics: tuple[Topic, ...]
    setup: RobotSetup
    frames: dict[str, str] = field(default_factory=dict)  # of the sensors' topics
    worlds: dict[str, str] = field(default_factory=dict)  # topics of poses by the world's frame
    plates: dict[str, str] = field(default_factory=dict)  # the world's frame by topics of wrenches
    fault: SymbidError | None = None  # why the first topic that is unusable is
    wheels: list[str] = field(default_factory=list)  # that roll on the ground

    def match_joints(self) -> None:
        """Choose the topics of joint states, and match their joints."""
        wanted = self.robot.measured_joint_names
        streams = self._joint_streams(wanted)
        if not streams and self.fault is not None:
            raise self.fault
        if not streams:
            raise BagError(
                f"{join_names(self.bags)}: no {JOINT_STATE} topic, it holds "
                f"{describe_topics(self.topics)}; record the joint states as well",
                "E210",
            )
        chosen: dict[str, str] = {}
        guesses: list[str] = []
        for topic, joints in sorted(streams.items(), key=lambda one: _preference(*one)):
            open_ = [name for name in wanted if name not in chosen.values()]
            new = [name for name in joints.names if name not in chosen]
            pairs, guessed = self._matched(topic, new, open_)
            if not pairs:
                if open_:
                    self.setup.note("joint_topic", f"{topic} names no joint of the model.")
                elif _names_all(joints, wanted):
                    self.setup.note(
                        "joint_topic",
                        f"CHECK: {topic} has joints of these names and efforts as well, and is "
                        "left out. Give the topic of this robot.",
                    )
                continue
            self._add_joint_topic(topic)
            guesses += guessed
            chosen |= pairs
        if not chosen:
            recorded = next((name for one in streams.values() for name in one.names), "NAME")
            raise DataError(
                f"{join_names(self.bags)}: no joint of {', '.join(streams)} resembles a joint of "
                f"{self.robot.source}; give the model of this robot, or write the pairs yourself: "
                + robot_file_line("rename_joint", f"{recorded}:={wanted[0]}"),
                "E306",
            )
        for recorded, name in chosen.items():
            if recorded != name:
                self.setup.add("rename_joint", f"{recorded}:={name}")
        if guesses:
            self.setup.note(
                "rename_joint",
                f"CHECK: guessed from words and order: {', '.join(guesses)}. Correct wrong pairs.",
            )
        topics = self.setup.options["joint_topic"]
        self.wheels = [name for one in topics for name in self._rolling(streams[one], chosen)]
        self._describe_joints(
            [name for topic in topics for name in streams[topic].names if name not in chosen]
        )
        for name in wanted:
            if name not in chosen.values():
                self.setup.add("hold_joint", f"{name}:=0.0", "CHECK: these positions are guesses.")

    def _rolling(self, joints: JointStream, chosen: Mapping[str, str]) -> list[str]:
        """Return the model's wheels among the joints of a topic that roll on the ground."""
        of_model = {joint.name: joint for joint in self.robot.joints}
        places = [place for place, name in enumerate(joints.names) if name in chosen]
        known = [of_model[chosen[joints.names[place]]] for place in places]
        return rolling_wheels(joints.position[:, places], known)

    def _add_joint_topic(self, topic: str) -> None:
        self.setup.add("joint_topic", topic)
        if _is_command(topic):
            self.setup.note(
                "joint_topic",
                f"CHECK: {topic} has the name of commands. Give the topic of what is measured.",
            )

    def _joint_streams(self, wanted: Sequence[str]) -> dict[str, JointStream]:
        """Return the first joint states of each topic that has usable ones.

        Of a log that lacks joints at first, as a driver may start late, return those that name the
        most joints.
        """
        found: dict[str, JointStream] = {}
        for fullest in (False, True):
            for topic in self._of_type(JOINT_STATE):
                if (streams := self._read(topic.name, fullest=fullest)) is not None:
                    found[topic.name] = streams.joints
            names = list(dict.fromkeys(name for one in found.values() for name in one.names))
            if len(match_names(names, wanted)[0]) == len(wanted):
                break
        return found

    def _matched(
        self, topic: str, recorded: Sequence[str], wanted: Sequence[str]
    ) -> tuple[dict[str, str], tuple[str, ...]]:
        """Match names of a topic as `match_names` does, of the first robot if it has several."""
        robots = joints_by_robot(recorded, wanted)
        if len(robots) < 2:
            return match_names(recorded, wanted)
        first, *_ = robots
        self.setup.note(
            "rename_joint",
            f"CHECK: {topic} has joints of {len(robots)} robots: {', '.join(robots)}. Those of "
            f"{first} are used.",
        )
        return robots[first], ()

    def _describe_joints(self, ignored: Sequence[str]) -> None:
        if ignored:
            self.setup.note("", f"Ignored joints of the log: {', '.join(ignored)}.")
        passive = [joint.name for joint in self.robot.joints if joint.effort == 0]
        if not set(self.robot.measured_joint_names) - set(passive):
            self.setup.note("", "The model states no drive; efforts in the log are used.")
            passive = []
        for joint in self.robot.joints:
            if joint.mimic is not None:
                leader = self.robot.joint_names[joint.mimic.leader]
                self.setup.note("", f"{joint.name} follows {leader}.")
            elif joint.name in passive:
                self.setup.note("", f"{joint.name} has no drive: its effort limit is 0.")

    def match_sensors(self, msgtype: str, option: str) -> None:
        """Choose the topics of IMUs or wrench sensors, and match their frames."""
        known = [*(frame.name for frame in self.robot.frames), *self.robot.link_names]
        for topic in self._of_type(msgtype):
            streams = self._read(self.setup.options["joint_topic"][0], topic)
            if streams is None:
                self.setup.note(option, f"{topic.name} is left out: its messages are not usable.")
                continue
            sensor = streams.imus[0] if streams.imus else streams.wrenches[0]
            frame = sensor.frame_id
            if frame in self.worlds and not streams.imus:
                self.setup.add(option, topic.name)
                self.plates[topic.name] = frame
                continue
            name = frame if frame in known else self._frame(frame, topic.name, known)
            if name is None:
                self.setup.note(
                    option, f"{topic.name} is left out: no frame of the model resembles {frame!r}."
                )
                self.setup.note("rename_frame", f"Give {frame}:=NAME to use {topic.name}.")
                continue
            self.setup.add(option, topic.name)
            self.frames[topic.name] = name
            if name != frame:
                self.setup.add("rename_frame", f"{frame}:={name}")

    def find_contacts(self) -> None:
        """Name the contacts of a robot without wrench sensors."""
        flags = contact_flags(self.topics, self.robot)
        if self.setup.options.get("wrench_topic"):
            if flags:
                self.setup.note("contact_flag", f"Not needed beside wrenches: {', '.join(flags)}.")
            return
        for topic, frame in flags.items():
            self.setup.add(
                "contact_flag", f"{topic}:={frame}", "CHECK: true must mean that it touches."
            )
        log = bag_log(self.bags, self.robot, TopicSelection.of(self.setup.log_options))
        try:
            contacts = assumed_contacts(self.robot, log)
        except SymbidError:
            contacts = ()  # the diagnosis states why the log cannot be read
        if contacts:
            self.setup.options["contact"] = list(contacts)
            self.setup.note(
                "contact",
                "CHECK: FRAME is a flat foot. FRAME:point or FRAME:RADIUS transmits a force alone, "
                "at the lowest point of the model's ball or of one with that radius in m.",
            )
            self.setup.note("contact", "A robot whose base is clamped needs base: fixed instead.")
        else:
            self.setup.options.pop("contact_flag", None)

    def find_poses(self) -> None:
        """Name the topic of the base's pose if there is no IMU."""
        found = [*self._of_type(POSE), *self._of_type(ODOMETRY)]
        for topic in found:
            if streams := self._read(self.setup.options["joint_topic"][0], topic):
                self.worlds.setdefault(streams.poses[0].world, topic.name)
        if self.setup.options.get("imu_topic"):
            for topic in found:
                self.setup.note(
                    "pose_topic", f"Beside the IMU, {topic.name} may be given if it is measured."
                )
        elif found:
            self._use_pose(found[0].name)

    def _use_pose(self, topic: str) -> None:
        self.setup.add("pose_topic", topic, "CHECK: it must be measured, not estimated.")
        if topic in [each.name for each in self._of_type(POSE)]:
            self.setup.add("pose_frame", self.robot.link_names[0], "CHECK: this is a guess.")

    def find_plates(self) -> None:
        """Name the pose that wrenches in world axes need, and the links that they act on."""
        if not self.plates:
            return
        worlds = dict.fromkeys(self.plates.values())
        if not self.setup.options.get("pose_topic"):
            self.setup.comments.pop("pose_topic", None)
            self._use_pose(self.worlds[next(iter(worlds))])
        found = self._plate_contacts()
        if "pose_frame" in self.setup.options and found.tracked != self.robot.link_names[0]:
            self.setup.options["pose_frame"] = [found.tracked]
            self.setup.comments["pose_frame"] = [
                "CHECK: if the pose is that of this frame, the forces on the plates pass the feet."
            ]
        for topic, link in found.links.items():
            self.setup.add(
                "plate_link",
                f"{topic}:={link}",
                "CHECK: the forces on the plates pass these frames.",
            )
        if unknown := [topic for topic in self.plates if topic not in found.links]:
            self.setup.note(
                "plate_link",
                f"CHECK: the log does not show what stands on {', '.join(unknown)}. Name it, or "
                "the wrench acts on the link of the tracked frame.",
            )

    def _plate_contacts(self) -> PlateContacts:
        """Find what stands on the plates in the log's first minute."""
        given = self.setup.log_options
        with suppress(SymbidError):  # the diagnosis states why the log cannot be read
            log = bag_log(self.bags, self.robot, TopicSelection.of(given))
            for piece in log.slices(MINUTE, warn=False):
                if piece.streams is not None:
                    tracked = self._tracked_frames(piece.streams.poses[0].frame_id)
                    return find_plate_contacts(
                        self.robot, piece.streams, tuple(self.plates), tracked
                    )
        return PlateContacts(self.robot.link_names[0], {})

    def _tracked_frames(self, stated: str) -> list[str]:
        """Return the frames that the pose may track, the most likely one first."""
        if "pose_frame" not in self.setup.options:
            return [stated]  # by an Odometry
        return [stated, *(frame.name for frame in self.robot.frames if frame.link == 0)]

    def find_drives(self) -> None:
        """Name the topic that tells when a wheeled base drives."""
        odometry = [each.name for each in self._of_type(ODOMETRY)]
        if len(odometry) == 1:
            self.setup.add("wheel_topic", odometry[0], "The base counts as fixed while it stands.")
            return
        if self.wheels:
            self.setup.note("wheel_topic", f"CHECK: {spelled(wheel_advice(self.wheels), str)}.")
        for topic in odometry or [each.name for each in self._of_type(IMU)]:
            self.setup.note("wheel_topic", f"If the base has wheels, {topic} may be given.")

    def _of_type(self, msgtype: str) -> list[Topic]:
        found = [topic for topic in self.topics if topic.msgtype == msgtype]
        return sorted(found, key=lambda topic: topic.name)

    def _frame(self, frame: str, topic: str, known: Sequence[str]) -> str | None:
        prefix = suggested_prefix(frame, self.robot)
        if prefix:
            return frame.removeprefix(prefix)
        sensors = [one.name for one in self.robot.frames]
        return most_similar(frame, topic, sensors) or most_similar(frame, topic, known)

    def _read(
        self, joints: str, sensor: Topic | None = None, *, fullest: bool = False
    ) -> Streams | None:
        """Return the first messages of a topic of joint states and of another sensor.

        ``fullest`` returns the first of those that name the most joints instead.
        """
        imus, wrenches, poses = (
            (sensor.name,) if sensor is not None and sensor.msgtype in msgtypes else ()
            for msgtypes in ((IMU,), (WRENCH,), (POSE, ODOMETRY))
        )
        selection = TopicSelection(
            joints=(joints,),
            imus=imus,
            wrenches=wrenches,
            poses=poses,
            mapping=SensorMapping(tracked=self.robot.link_names[0]),
        )
        found: Streams | None = None
        try:
            for piece in bag_log(self.bags, topics=selection).slices(SPAN, warn=False):
                if piece.streams is None:
                    continue
                if found is None or len(piece.streams.joints.names) > len(found.joints.names):
                    found = piece.streams
                if not fullest:
                    break
        except SymbidError as error:
            self.fault = self.fault or error
        return found


def contact_flags(topics: Sequence[Topic], robot: RobotModel) -> dict[str, str]:
    """Return the frames of contacts by the Bool topics that are about them.

    Topics whose name resembles no frame, or the same frame as another, are left out.
    """
    sensors = [frame.name for frame in robot.frames]
    known = [*sensors, *robot.link_names]
    found: dict[str, str] = {}
    for topic in sorted(topics, key=lambda one: one.name):
        if topic.msgtype != BOOL or not CONTACT_WORDS.search(topic.name):
            continue
        name = CONTACT_WORDS.sub("", topic.name)
        frame = most_similar(name, "", sensors) or most_similar(name, "", known)
        if frame is not None and frame not in found.values():
            found[topic.name] = frame
    return found


def _preference(topic: str, joints: JointStream) -> tuple[bool, bool, bool, int, str]:
    """Return a key that sorts measured joint states before commands."""
    is_other = topic.rsplit("/", 1)[-1] != "joint_states"
    return is_other, not _has_efforts(joints), _is_command(topic), topic.count("/"), topic


def _is_command(topic: str) -> bool:
    return any(word in topic.lower() for word in COMMAND_WORDS)


def _names_all(joints: JointStream, wanted: Sequence[str]) -> bool:
    """Return whether joint states have all wanted joints, with efforts."""
    return _has_efforts(joints) and len(match_names(joints.names, wanted)[0]) == len(wanted)


def _has_efforts(joints: JointStream) -> bool:
    return bool(np.isfinite(joints.effort).any())
