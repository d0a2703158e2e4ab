"""Finds out how a log of a robot is to be read, and writes it as a robot file.

Names are matched first. Then the equation of motion, with the model's inertias within ±25 %, tells
wrong signs and units, as in `symbid bag doctor`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from symbid_ros.arrays import concatenated
from symbid_ros.atomic_write import write_text
from symbid_ros.bags import bag_log, count_messages, join_names
from symbid_ros.choices import Base
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Diagnosis, Kind, Severity
from symbid_ros.diagnosis.forces import GAINS
from symbid_ros.diagnosis.wrist_evidence import unnamed_sensors
from symbid_ros.errors import BagError, DataError, ModelError, SymbidError
from symbid_ros.identification.dataset import AlignedLog
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import TRUTH, Topic, TopicSelection, describe_topics
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH
from symbid_ros.model.load import load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors
from symbid_ros.offline.name_matching import match_names, most_similar
from symbid_ros.options import options_of
from symbid_ros.signals.alignment import suggested_prefix
from symbid_ros.signals.sensor_samples import probed
from symbid_ros.signals.streams import JointStream, Streams

SPAN = 4 * 10**9  # ns of a log that show its names
# A gain is corrected if it is known to this share.
KNOWN = 0.25
ANGLES = "roll", "pitch", "yaw"
ROUNDS = 3  # of corrections, since one wrong sign can hide another


@dataclass
class RobotSetup:
    """What a robot file says.

    Attributes
    ----------
    model : Path
    base : {"floating", "fixed"}
    options : dict of str to list of str
        Values of fields of `LogOptions` and `IdentifyOptions`.
    comments : dict of str to list of str
        Lines about each option, and about the file under the empty name.
    diagnosis : Diagnosis or None
        What the doctor says of the log, read with these options.
    """

    model: Path
    base: str
    options: dict[str, list[str]] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None

    def note(self, option: str, line: str) -> None:
        """Add a comment about an option."""
        lines = self.comments.setdefault(option, [])
        if line not in lines:
            lines.append(line)

    def add(self, option: str, value: str, reason: str = "") -> None:
        """Add a value of an option."""
        self.options.setdefault(option, []).append(value)
        if reason:
            self.note(option, reason)

    @property
    def log_options(self) -> LogOptions:
        """The options that say how to read a log."""
        names = {option.name for option in options_of(LogOptions)}
        given: dict[str, Any] = {
            name: tuple(values) for name, values in self.options.items() if name in names
        }
        return LogOptions(**given)

    def write(self, path: Path) -> None:
        """Write the robot file."""
        write_text(path, "\n".join(self._lines()) + "\n")

    def _lines(self) -> Iterator[str]:
        yield "# How to read the logs of this robot: a ROS parameter file."
        yield "# Commands:  symbid identify BAG --robot THIS_FILE --out FOLDER"
        yield "# Node:      ros2 run symbid_ros identifier --ros-args --params-file THIS_FILE"
        for line in self.comments.get("", []):
            yield f"# {line}"
        yield "/**:"
        yield "  ros__parameters:"
        yield f"    model: {_scalar(str(self.model))}"
        yield f"    base: {self.base}"
        for name, what in DESCRIPTIONS.items():
            values = self.options.get(name, [])
            yield ""
            for line in (what, *self.comments.get(name, [])):
                yield f"    # {line}"
            if values:
                yield f"    {name}:"
                yield from (f"      - {_scalar(value)}" for value in values)
            else:
                yield f"    # {name}: {EXAMPLES[name]}"


# Options in the order of the file, with the comment above each.
DESCRIPTIONS = {
    "joint_topic": "Topics of joint states.",
    "imu_topic": "Topics of IMUs, which a floating base needs.",
    "wrench_topic": "Topics of wrench sensors, one for each contact.",
    "rename_joint": "NAME_IN_LOG:=NAME_IN_MODEL of joints.",
    "rename_frame": "NAME_IN_LOG:=NAME_IN_MODEL of the sensors' frames.",
    "hold_joint": "JOINT:=POSITION in rad (m) of joints that the log lacks.",
    "effort_scale": "JOINT:=NM_PER_UNIT of efforts that are not in Nm (N), such as currents.",
    "drive_gain": "Joints whose effort_scale is uncertain; its error is identified, not live.",
    "flip_wrench": "Frames whose sensor measures the wrench of the robot on its environment.",
    "rotate_imu": "FRAME:=ROLL,PITCH,YAW in degrees of an IMU's axes in its frame of the model.",
    "contact": "Frames at which something touches the robot without a wrench sensor.",
    "wrist_sensor": "Frames of force/torque sensors between two links, with a payload beyond them.",
    "effort_side": "Where efforts are measured: motor or link (behind the gear).",
    "coupling": "Sums of joints with which one motor turns.",
    "ripple": "JOINT:PERIODS in a turn of torques that repeat with the joint's angle.",
    "sensor_errors": "Sensor errors to identify.",
    "prior_percent": "Standard deviation of the model's values in percent of each value.",
    "total_mass": "Weighed mass of the robot in kg. It sets the scale of all masses.",
    "joint_terms": "Friction, armature and offsets: auto, none, or names of terms.",
}
EXAMPLES = {
    "joint_topic": "[/joint_states]",
    "imu_topic": "[/imu/data]",
    "wrench_topic": "[/left_foot/wrench]",
    "rename_joint": "[j1:=shoulder_joint]",
    "rename_frame": "[xsens:=imu_link]",
    "hold_joint": "[wrist_joint:=0.0]",
    "effort_scale": "[elbow_joint:=0.11]",
    "drive_gain": "[elbow_joint]",
    "flip_wrench": "[left_sole]",
    "rotate_imu": "['imu_link:=180,0,90']",
    "contact": "[left_sole]",
    "wrist_sensor": "[tool0]",
    "effort_side": "[motor]",
    "coupling": "[joint_5+joint_6]",
    "ripple": "['joint_6:4']",
    "sensor_errors": "[torque_gain]",
    "prior_percent": "25.0",
    "total_mass": "42.0",
    "joint_terms": "[auto]",
}


def inspect_robot(model: Path, bags: Sequence[Path], base: Base = "auto") -> RobotSetup:
    """Find out how the log in bags is to be read for a model.

    Parameters
    ----------
    model : Path
        URDF or MJCF.
    bags : sequence of Path
        Bags of one recording.
    base : {"auto", "floating", "fixed"}
        Whether the base of a URDF may move; auto: as the model says, and fixed without any IMU.

    Raises
    ------
    ModelError, BagError, DataError
        When the model or the bags cannot be read, or the log has no joint states.
    """
    topics = {
        topic: count
        for topic, count in count_messages(bags).items()
        if count and TRUTH not in topic.name.split("/")
    }
    robot = load_model(model, base)
    has_imu = any(topic.msgtype == IMU for topic in topics)
    if base == "auto" and robot.floating and not has_imu:
        robot = load_model(model, "fixed")
    robot = bag_log(bags).applied_to(robot)
    setup = RobotSetup(model.absolute(), "floating" if robot.floating else "fixed")
    inspector = _Inspector(tuple(bags), robot, tuple(topics), setup)
    inspector.match_joints()
    if robot.floating:
        inspector.match_sensors(IMU, "imu_topic")
    inspector.match_sensors(WRENCH, "wrench_topic")
    inspector.find_wrist_sensors()
    inspector.correct_signs_and_units()
    return setup


def expand_xacro(file: Path, out: Path) -> None:
    """Write the URDF that a xacro file describes. xacro evaluates Python expressions in the file.

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
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(
            f"{file}: xacro: {reason}; correct the file, and for $(find PACKAGE) source the "
            "workspace of the package",
            "E119",
        ) from None
    write_text(out, document.toprettyxml(indent="  "))


@dataclass
class _Inspector:
    """Fills a setup from the topics of one recording."""

    bags: tuple[Path, ...]
    robot: RobotModel
    topics: tuple[Topic, ...]
    setup: RobotSetup
    frames: dict[str, str] = field(default_factory=dict)  # of the sensors' topics

    def match_joints(self) -> None:
        """Choose the topics of joint states, and match their joints."""
        streams = {
            topic.name: found.joints
            for topic in self._of_type(JOINT_STATE)
            if (found := self._read(topic.name)) is not None
        }
        if not streams:
            raise BagError(
                f"{join_names(self.bags)}: no usable {JOINT_STATE} topic, it holds "
                f"{describe_topics(self.topics)}; record the joint states as well",
                "E210",
            )
        wanted = self.robot.measured_joint_names
        chosen: dict[str, str] = {}
        certain = True
        for topic, joints in sorted(streams.items(), key=lambda one: _preference(*one)):
            open_ = [name for name in wanted if name not in chosen.values()]
            new = [name for name in joints.names if name not in chosen]
            pairs, is_certain = match_names(new, open_)
            if not pairs:
                if open_:
                    self.setup.note("joint_topic", f"{topic} names no joint of the model.")
                continue
            self.setup.add("joint_topic", topic)
            certain = certain and is_certain
            chosen |= pairs
        if not chosen:
            raise DataError(
                f"{join_names(self.bags)}: no joint of {', '.join(streams)} resembles a joint of "
                f"{self.robot.source}; give the model of this robot",
                "E306",
            )
        for recorded, name in chosen.items():
            if recorded != name:
                self.setup.add("rename_joint", f"{recorded}:={name}")
        if not certain:
            self.setup.note("rename_joint", "CHECK: some are matched by their order alone.")
        topics = self.setup.options["joint_topic"]
        self._describe_joints(
            [name for topic in topics for name in streams[topic].names if name not in chosen]
        )
        for name in wanted:
            if name not in chosen.values():
                self.setup.add("hold_joint", f"{name}:=0.0", "CHECK: these positions are guesses.")

    def _describe_joints(self, ignored: Sequence[str]) -> None:
        if ignored:
            self.setup.note("", f"Ignored joints of the log: {', '.join(ignored)}.")
        for joint in self.robot.joints:
            if joint.mimic is not None:
                leader = self.robot.joint_names[joint.mimic.leader]
                self.setup.note("", f"{joint.name} follows {leader}.")
            elif joint.effort == 0:
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

    def find_wrist_sensors(self) -> None:
        """Name the wrench sensors whose force is that of a body fixed to them."""
        if self.robot.floating or not self.setup.options.get("wrench_topic"):
            return
        log = bag_log(self.bags, self.robot, TopicSelection.of(self.setup.log_options))
        try:
            samples = [probed(segment, self.robot) for segment in AlignedLog(log, self.robot)]
        except SymbidError:
            return  # which the diagnosis states
        for evidence in unnamed_sensors(self.robot, concatenated(samples)):
            mass, share = abs(evidence.mass()[0]), evidence.share
            self.setup.add(
                "wrist_sensor",
                evidence.sensor,
                f"{100 * share:.0f} % of the force is that of a body of {mass:.3g} kg.",
            )

    def correct_signs_and_units(self) -> None:
        """Correct wrong signs and units until the doctor finds none."""
        found = self._diagnosed()
        for _ in range(ROUNDS):
            kinds = {one.kind for one in found.findings}
            if not kinds & CORRECTABLE or not self._correct(found):
                break
            found = self._diagnosed()
        self.setup.diagnosis = found
        for one in found.findings:
            if one.severity is Severity.UNUSABLE:
                self.setup.note("", f"CHECK: {one.message}")

    def _diagnosed(self) -> Diagnosis:
        """Return what the doctor says of the log, read with the options so far."""
        log = bag_log(self.bags, self.robot, TopicSelection.of(self.setup.log_options))
        sensors = self.setup.options.get("wrist_sensor", [])
        return diagnose(log, with_wrist_sensors(self.robot, sensors))

    def _correct(self, found: Diagnosis) -> bool:
        """Change signs and units as the diagnosis implies; return whether any changed."""
        common = found.figures.get("gain", 1.0) or 1.0
        before = {name: list(values) for name, values in self.setup.options.items()}
        for frame in self.frames.values():
            if found.figures.get(f"{frame}/gain", 1.0) < 0:
                self._flip(frame)
        for name in self.robot.joint_names:
            gain = found.figures.get(f"{name}/effort_gain")
            std = found.figures.get(f"{name}/effort_gain_std", 0.0)
            if gain is None or std > KNOWN * abs(gain):
                continue
            if not GAINS[0] < gain / common < GAINS[1]:
                self._scale(name, gain / common)
        for one in found.findings:
            place = self.frames.get(one.stream, "")
            if one.kind is Kind.IMU_MOUNTING and place and "roll_deg" in one.figures:
                self._rotate(place, [one.figures[f"{angle}_deg"] for angle in ANGLES])
        return self.setup.options != before

    def _rotate(self, frame: str, angles: Sequence[float]) -> None:
        rotated = self.setup.options.get("rotate_imu", [])
        if not any(entry.startswith(f"{frame}:=") for entry in rotated):
            value = ",".join(f"{angle:.1f}" for angle in angles)
            self.setup.add("rotate_imu", f"{frame}:={value}", "CHECK: found from the motion.")

    def _flip(self, frame: str) -> None:
        flipped = self.setup.options.setdefault("flip_wrench", [])
        if frame in flipped:
            flipped.remove(frame)
        else:
            self.setup.add("flip_wrench", frame, "Found from the equation of motion.")

    def _scale(self, joint: str, factor: float) -> None:
        entries = dict(entry.split(":=", 1) for entry in self.setup.options.get("effort_scale", []))
        entries[joint] = f"{factor * float(entries.get(joint, 1.0)):.3g}"
        self.setup.options["effort_scale"] = [f"{name}:={at}" for name, at in entries.items()]
        self.setup.options["drive_gain"] = list(entries)
        self.setup.note(
            "effort_scale",
            "CHECK: found from the model's inertias; better give gear ratio times torque constant.",
        )

    def _of_type(self, msgtype: str) -> list[Topic]:
        found = [topic for topic in self.topics if topic.msgtype == msgtype]
        return sorted(found, key=lambda topic: topic.name)

    def _frame(self, frame: str, topic: str, known: Sequence[str]) -> str | None:
        prefix = suggested_prefix(frame, self.robot)
        if prefix:
            return frame.removeprefix(prefix)
        sensors = [one.name for one in self.robot.frames]
        return most_similar(frame, topic, sensors) or most_similar(frame, topic, known)

    def _read(self, joints: str, sensor: Topic | None = None) -> Streams | None:
        """Return the first messages of a topic of joint states and of another sensor."""
        imus, wrenches = (
            (sensor.name,) if sensor is not None and sensor.msgtype == msgtype else ()
            for msgtype in (IMU, WRENCH)
        )
        selection = TopicSelection(joints=(joints,), imus=imus, wrenches=wrenches)
        try:
            for piece in bag_log(self.bags, topics=selection).slices(SPAN, warn=False):
                if piece.streams is not None:
                    return piece.streams
        except SymbidError:
            return None
        return None


CORRECTABLE = {
    Kind.IMU_MOUNTING,
    Kind.WRENCH_SIGN,
    Kind.TORQUE_SIGN,
    Kind.TORQUE_GAIN,
    Kind.CONTRADICTION,
    Kind.WEIGHT,
}


def _preference(topic: str, joints: JointStream) -> tuple[bool, bool, int, str]:
    """Return a key that sorts measured joint states before commands."""
    has_efforts = bool((joints.effort == joints.effort).any())
    return topic.rsplit("/", 1)[-1] != "joint_states", not has_efforts, topic.count("/"), topic


def _scalar(value: str) -> str:
    """Return a text as YAML, in quotes where needed."""
    return yaml.safe_dump(value, width=10_000).splitlines()[0]
