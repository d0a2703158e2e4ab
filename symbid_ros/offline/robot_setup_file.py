"""The robot file that `symbid init` writes: values of options, each with a comment."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from symbid_ros.atomic_write import write_text
from symbid_ros.diagnosis.findings import Diagnosis, Severity
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import options_of


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
    has_open_question : bool
        Whether a line is a guess that only the user can confirm, or a sign or unit is still wrong.
    """

    model: Path
    base: str
    options: dict[str, list[str]] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    has_open_question: bool = False

    @property
    def is_usable(self) -> bool:
        """Whether the log can be identified as the file says."""
        found = self.diagnosis
        is_unusable = found is not None and found.severity is Severity.UNUSABLE
        return not (self.has_open_question or is_unusable)

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
            name: values[0] if name in SCALARS else tuple(values)
            for name, values in self.options.items()
            if name in names
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
        yield f"    model: {_yaml(str(self.model))}"
        for line in self.comments.get("base", []):
            yield f"    # {line}"
        yield f"    base: {self.base}"
        for name, what in DESCRIPTIONS.items():
            values = self.options.get(name, [])
            yield ""
            for line in (what, *self.comments.get(name, [])):
                yield f"    # {line}"
            if values and name in SCALARS:
                yield f"    {name}: {_yaml(values[0])}"
            elif values and name in NUMBERS:
                yield f"    {name}: [{', '.join(values)}]"
            elif values:
                yield f"    {name}:"
                yield from (f"      - {_yaml(value)}" for value in values)
            else:
                yield f"    # {name}: {EXAMPLES[name]}"


SCALARS = frozenset({"pose_frame"})  # options with one value
NUMBERS = frozenset({"gravity"})
# Options in the order of the file, with the comment above each.
DESCRIPTIONS = {
    "gravity": "Direction of gravity in the axes of a fixed base.",
    "joint_topic": "Topics of joint states.",
    "imu_topic": "Topics of IMUs, which a floating base needs.",
    "wrench_topic": "Topics of wrench sensors, one for each contact.",
    "pose_topic": "Topic of a floating base's pose, as from motion capture.",
    "pose_frame": "Frame of the robot that pose_topic tracks.",
    "plate_link": "TOPIC:=LINK of force plates in world axes: the link that stands on each.",
    "wheel_topic": "Odometry of a wheeled base, or an IMU on it: its driving times are left out.",
    "rename_joint": "NAME_IN_LOG:=NAME_IN_MODEL of joints.",
    "flip_joint": "Joints whose positions and velocities have the opposite sign.",
    "rename_frame": "NAME_IN_LOG:=NAME_IN_MODEL of the sensors' frames.",
    "hold_joint": "JOINT:=POSITION in rad (m) of joints that the log lacks.",
    "position_scale": "JOINT:=FACTOR from positions and velocities to rad (m), as for degrees.",
    "effort_scale": "JOINT:=FACTOR from efforts to Nm (N), as for currents.",
    "drive_gain": "Joints whose effort_scale is uncertain; its error is identified offline only.",
    "flip_wrench": "Frames whose sensor measures the wrench of the robot on its environment.",
    "rotate_imu": "FRAME:=ROLL,PITCH,YAW in degrees of an IMU's axes in its frame of the model.",
    "contact": "Frames at which something touches the robot without a wrench sensor.",
    "contact_flag": "TOPIC:=FRAME of Bool topics that are true while a contact touches something.",
    "force_only": "FRAME:RADIUS of foot sensors without moments, on balls of that radius.",
    "end_stops": "Joints that lean on the ends of their ranges; their rows there are left out.",
    "wrist_sensor": "Frames of force/torque sensors between two links, with a payload beyond them.",
    "effort_side": "Where efforts are measured: motor or link (behind the gear).",
    "coupling": "Drives whose speed is a sum of joint speeds.",
    "ripple": "Torque ripple, as JOINT:PERIODS in a turn of the joint.",
    "sensor_errors": "Sensor errors to identify.",
    "prior_percent": "How far each value of the model may be wrong, in percent.",
    "total_mass": "Weighed mass of the robot in kg. It sets the scale of all masses.",
    "joint_terms": "Friction, armature and offsets: auto, none, or names of terms.",
}
EXAMPLES = {
    "gravity": "[0.0, 0.0, -1.0]",
    "joint_topic": "[/joint_states]",
    "imu_topic": "[/imu/data]",
    "wrench_topic": "[/left_foot/wrench]",
    "pose_topic": "[/mocap/pose]",
    "pose_frame": "base_link",
    "plate_link": "['/plate_1/wrench:=left_foot']",
    "wheel_topic": "[/odom]",
    "rename_joint": "['j1:=shoulder_joint']",
    "flip_joint": "[elbow_joint]",
    "rename_frame": "['xsens:=imu_link']",
    "hold_joint": "['wrist_joint:=0.0']",
    "position_scale": "['elbow_joint:=0.0174533']",
    "effort_scale": "['elbow_joint:=0.11']",
    "drive_gain": "[elbow_joint]",
    "flip_wrench": "[left_sole]",
    "rotate_imu": "['imu_link:=180,0,90']",
    "contact": "[left_sole]",
    "contact_flag": "['/left_foot/contact:=left_sole']",
    "force_only": "['left_foot:0.02']",
    "end_stops": "[knee_joint]",
    "wrist_sensor": "[tool0]",
    "effort_side": "[motor]",
    "coupling": "[joint_5+joint_6]",
    "ripple": "['joint_6:4']",
    "sensor_errors": "[torque_gain]",
    "prior_percent": "25.0",
    "total_mass": "42.0",
    "joint_terms": "[auto]",
}


def _yaml(value: str) -> str:
    """Return a text as YAML, in quotes where needed."""
    return yaml.safe_dump(value, width=10_000).splitlines()[0]
