"""Finds out how a log of a robot is to be read, and writes it as a robot file.

Names are matched first. Then the equation of motion, with the model's inertias within ±25 %, tells
wrong signs and units, as in `symbid bag doctor`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np

from symbid_ros.arrays import concatenated
from symbid_ros.atomic_write import write_text
from symbid_ros.bags import bag_log, count_messages, join_names
from symbid_ros.choices import Base
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity
from symbid_ros.diagnosis.forces import GAINS, MILLI, common_unit
from symbid_ros.diagnosis.joint_checks import DEGREES
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import unnamed_sensors
from symbid_ros.errors import BagError, DataError, ModelError, SymbidError
from symbid_ros.identification.assumed_contacts import assumed_contacts, leg_ends
from symbid_ros.identification.base_gravity import find_gravity, searches_gravity
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.dataset import AlignedLog
from symbid_ros.identification.joint_readings import find_readings
from symbid_ros.identification.log_reading import MINUTE, first_segments
from symbid_ros.identification.position_units import find_degrees
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.messages.topics import TRUTH, Topic, TopicSelection, describe_topics
from symbid_ros.messages.types import IMU, JOINT_STATE, POSE, WRENCH
from symbid_ros.model.load import is_mjcf, load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.base_topics import contact_flags, odometry_topics, pose_topics
from symbid_ros.offline.name_matching import joints_by_robot, match_names, most_similar
from symbid_ros.offline.robot_setup_file import RobotSetup
from symbid_ros.signals.alignment import suggested_prefix
from symbid_ros.signals.sensor_samples import probed
from symbid_ros.signals.streams import JointStream, Streams

SPAN = 4 * 10**9  # ns of a log that show its names
# A gain is corrected if it is known to this share.
KNOWN = 0.25
ANGLES = "roll", "pitch", "yaw"
ROUNDS = 3  # of corrections, since one wrong sign can hide another
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
        if count and TRUTH not in topic.name.split("/")
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
            "the base. If the base moved, record one of them.",
        )
    inspector = _Inspector(tuple(bags), robot, tuple(topics), setup)
    inspector.match_joints()
    if robot.floating:
        inspector.match_sensors(IMU, "imu_topic")
    inspector.match_sensors(WRENCH, "wrench_topic")
    if robot.floating:
        inspector.find_poses()
        inspector.find_contacts()
    else:
        inspector.find_drives()
    inspector.find_wrist_sensors()
    inspector.convert_degrees()
    inspector.correct_joints()
    inspector.find_mounting()
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
    fault: SymbidError | None = None  # why the first topic that is unusable is

    def match_joints(self) -> None:
        """Choose the topics of joint states, and match their joints."""
        streams = {
            topic.name: found.joints
            for topic in self._of_type(JOINT_STATE)
            if (found := self._read(topic.name)) is not None
        }
        if not streams and self.fault is not None:
            raise self.fault
        if not streams:
            raise BagError(
                f"{join_names(self.bags)}: no {JOINT_STATE} topic, it holds "
                f"{describe_topics(self.topics)}; record the joint states as well",
                "E210",
            )
        wanted = self.robot.measured_joint_names
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
            self.setup.add("joint_topic", topic)
            guesses += guessed
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
        if guesses:
            self.setup.note(
                "rename_joint",
                f"CHECK: guessed from words and order: {', '.join(guesses)}. Correct wrong pairs.",
            )
        topics = self.setup.options["joint_topic"]
        self._describe_joints(
            [name for topic in topics for name in streams[topic].names if name not in chosen]
        )
        for name in wanted:
            if name not in chosen.values():
                self.setup.add("hold_joint", f"{name}:=0.0", "CHECK: these positions are guesses.")

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
                "contact", "CHECK: feet without a moment end in :point, balls in their radius."
            )
        else:
            self.setup.options.pop("contact_flag", None)

    def find_poses(self) -> None:
        """Name the topic of the base's pose if there is no IMU."""
        poses = pose_topics(self.topics)
        found = [*poses, *odometry_topics(self.topics)]
        if self.setup.options.get("imu_topic"):
            for topic in found:
                self.setup.note(
                    "pose_topic", f"Beside the IMU, {topic} may be given if it is measured."
                )
        elif found:
            self.setup.add("pose_topic", found[0], "CHECK: it must be measured, not estimated.")
            if poses:
                self.setup.add("pose_frame", self.robot.link_names[0], "CHECK: this is a guess.")

    def find_drives(self) -> None:
        """Name the topic that tells when a wheeled base drives."""
        odometry = odometry_topics(self.topics)
        if len(odometry) == 1:
            self.setup.add("drive_topic", odometry[0], "The base counts as fixed while it stands.")
            return
        for topic in odometry or [each.name for each in self._of_type(IMU)]:
            self.setup.note("drive_topic", f"If the base has wheels, {topic} may be given.")

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

    def convert_degrees(self) -> None:
        """Convert positions that their velocities, limits or the efforts show to be in degrees."""
        robot = with_robot_options(self.robot, self._given)
        log = bag_log(self.bags, robot, TopicSelection.of(self.setup.log_options))
        checks = StreamChecks(robot)
        try:
            for piece in islice(log.slices(MINUTE, warn=False), 1):
                checks.take(piece)
        except SymbidError:
            return  # which the diagnosis states
        hinges = {joint.name for joint in robot.joints if joint.kind == "revolute"}
        names = [name for name in robot.measured_joint_names if name in hinges]
        in_degrees = [one for one in checks.unit_findings() if _is_of_degrees(one, checks)]
        if in_degrees:
            single = [name for name in names if f"{name}/scale" in in_degrees[0].figures]
            names = single or names
        elif find_degrees(first_segments(log, robot), robot) is None:
            return
        for name in names:
            self.setup.add("position_scale", f"{name}:={1 / DEGREES:.9g}")
        self.setup.note("position_scale", "CHECK: positions are taken to be in degrees.")

    def correct_joints(self) -> None:
        """Exchange and reverse joints of the log if the efforts are then explained.

        Otherwise scales and signs of efforts would explain a part of them.
        """
        options = self.setup.options
        robot = with_robot_options(self.robot, self._given)
        log = bag_log(self.bags, robot, TopicSelection.of(self.setup.log_options))
        readings = find_readings(first_segments(log, robot), robot)
        if readings is None:
            return
        if owners := readings.exchanged:
            renamed = dict(entry.split(":=", 1) for entry in options.get("rename_joint", []))
            renamed = {name: name for name in owners if name not in renamed.values()} | renamed
            new = {recorded: owners.get(name, name) for recorded, name in renamed.items()}
            options["rename_joint"] = [f"{one}:={name}" for one, name in new.items() if one != name]
            self.setup.note(
                "rename_joint",
                f"CHECK: found from the efforts: the log exchanges {', '.join(owners)}.",
            )
        for name, has_effort in readings.reversed_joints.items():
            self.setup.add("flip_joint", name, "CHECK: found from the efforts.")
            if has_effort:
                reason = "CHECK: the log reverses these joints together with their motion."
                self.setup.add("effort_scale", f"{name}:=-1.0", reason)

    def find_mounting(self) -> None:
        """Say how gravity acts on a fixed base if the efforts contradict the model."""
        robot = with_robot_options(self.robot, self._given)
        if not searches_gravity(self._given, robot):
            return
        log = bag_log(self.bags, robot, TopicSelection.of(self.setup.log_options))
        found = find_gravity(first_segments(log, robot), robot)
        if found is not None:
            self.setup.note("gravity", "CHECK: found from the efforts.")
            for one in found.value.split():
                self.setup.add("gravity", one)

    @property
    def _given(self) -> RobotOptions:
        """What the options so far say of the robot."""
        given = self.setup.options
        direction = None
        if "gravity" in given:
            x, y, z = map(float, given["gravity"])
            direction = (x, y, z)
        contacts, sensors = (tuple(given.get(name, ())) for name in ("contact", "wrist_sensor"))
        return RobotOptions(contact=contacts, wrist_sensor=sensors, gravity=direction)

    def correct_signs_and_units(self) -> None:
        """Correct wrong signs and units until the doctor finds none."""
        found = self._diagnosed()
        for _ in range(ROUNDS):
            if not _is_correctable(found) or not self._correct(found):
                break
            found = self._diagnosed()
        self.setup.diagnosis = found
        for one in found.findings:
            start = "CHECK" if one.severity is Severity.UNUSABLE else "Doctor"
            self.setup.note("", f"{start}: {one.message}")

    def _diagnosed(self) -> Diagnosis:
        """Return what the doctor says of the log, read with the options so far."""
        log = bag_log(self.bags, self.robot, TopicSelection.of(self.setup.log_options))
        return diagnose(log, with_robot_options(self.robot, self._given))

    def _correct(self, found: Diagnosis) -> bool:
        """Change signs and units as the diagnosis implies; return whether any changed."""
        common = found.figures.get("gain", 1.0) or 1.0
        before = {name: list(values) for name, values in self.setup.options.items()}
        for frame in self.frames.values():
            if found.figures.get(f"{frame}/gain", 1.0) < 0:
                self._flip(frame)
        factors, unknown = {}, []
        for name in self.robot.joint_names:
            gain = found.figures.get(f"{name}/effort_gain")
            std = found.figures.get(f"{name}/effort_gain_std", 0.0)
            if gain is None:
                continue
            if std > KNOWN * max(abs(gain), 1.0):
                unknown.append(name)
            else:
                factors[name] = gain / common
        scaled = {name: one for name, one in factors.items() if not GAINS[0] < one < GAINS[1]}
        usual = median(map(abs, scaled.values())) if scaled else 1.0
        if len(scaled) == len(factors) and not GAINS[0] < usual < GAINS[1]:
            # No joint has the unit of the model, so those without a visible load have not either.
            unit = common_unit(scaled.values())
            self._scale(scaled | dict.fromkeys(unknown, usual), unit)
        else:
            self._scale(scaled)
            beyond = [name for name in unknown if f"{name}/times_limit" in _figures(found)]
            self._scale(dict.fromkeys(beyond, MILLI), MILLI)
        if "effort_scale" not in self.setup.options:
            self._reverse_efforts(found)
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

    def _reverse_efforts(self, found: Diagnosis) -> None:
        """Change the signs of efforts that are wrong together, whose size is not known well."""
        for one in found.findings:
            if one.kind is Kind.TORQUE_SIGN:
                joints = [name.removesuffix("/gain") for name in one.figures]
                self.setup.options["effort_scale"] = [f"{name}:=-1.0" for name in joints]
                self.setup.note("effort_scale", "CHECK: all joints together show this sign.")

    def _scale(self, factors: Mapping[str, float], unit: float | None = None) -> None:
        """Multiply efforts of joints by factors, or by that of their unit, which is exact."""
        if not factors:
            return
        entries = dict(entry.split(":=", 1) for entry in self.setup.options.get("effort_scale", []))
        for joint, factor in factors.items():
            entries[joint] = f"{(unit or factor) * float(entries.get(joint, 1.0)):.3g}"
        self.setup.options["effort_scale"] = [f"{name}:={at}" for name, at in entries.items()]
        if unit is not None:
            name = "mNm (Nmm)" if unit == MILLI else f"{unit:g} Nm"
            self.setup.note(
                "effort_scale", f"CHECK: efforts of {', '.join(factors)} are in {name}."
            )
            return
        drives = self.setup.options.get("drive_gain", [])
        self.setup.options["drive_gain"] = list(dict.fromkeys([*drives, *factors]))
        self.setup.note(
            "effort_scale",
            "CHECK: found from the model's inertias, or from other joints if no load shows it; "
            "better give gear ratio times torque constant.",
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
        except SymbidError as error:
            self.fault = self.fault or error
        return None


CORRECTABLE = {
    Kind.IMU_MOUNTING,
    Kind.WRENCH_SIGN,
    Kind.TORQUE_SIGN,
    Kind.TORQUE_GAIN,
    Kind.CONTRADICTION,
    Kind.WEIGHT,
}


def _is_of_degrees(finding: Finding, checks: StreamChecks) -> bool:
    """Return whether a finding says that positions of joints are in degrees."""
    is_unit = finding.kind is Kind.UNIT and finding.severity is Severity.UNUSABLE
    return is_unit and finding.stream == checks.joint_topic


def _figures(found: Diagnosis) -> dict[str, float]:
    """Return the figures of all findings about gains of efforts."""
    gains = (one.figures for one in found.findings if one.kind is Kind.TORQUE_GAIN)
    return {name: value for figures in gains for name, value in figures.items()}


def _is_correctable(found: Diagnosis) -> bool:
    return any(one.kind in CORRECTABLE for one in found.findings)


def _preference(topic: str, joints: JointStream) -> tuple[bool, bool, int, str]:
    """Return a key that sorts measured joint states before commands."""
    is_other = topic.rsplit("/", 1)[-1] != "joint_states"
    return is_other, not _has_efforts(joints), topic.count("/"), topic


def _names_all(joints: JointStream, wanted: Sequence[str]) -> bool:
    """Return whether joint states have all wanted joints, with efforts."""
    return _has_efforts(joints) and len(match_names(joints.names, wanted)[0]) == len(wanted)


def _has_efforts(joints: JointStream) -> bool:
    return bool(np.isfinite(joints.effort).any())
