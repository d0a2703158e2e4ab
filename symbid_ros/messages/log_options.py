"""Options that select topics and a part of a recording, and say how they relate to the model."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from symbid_ros.errors import OptionError
from symbid_ros.options import check_values, option, options_of

GROUP = "Topics and time"
MAPPING = "How the log differs from the model"
PART = {"start", "stop"}


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Topics and part of a recording to read.

    Attributes
    ----------
    of_robot : tuple of str
        Names of the options that come from a robot file or another log of the robot, and so may
        name joints and frames that this log lacks.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    start: float = option(
        0.0, "Seconds to skip after the first joint state.", unit="s", minimum=0.0, group=GROUP
    )
    stop: float | None = option(
        None,
        "Seconds after the first joint state at which to stop.",
        unit="s",
        minimum=0.0,
        group=GROUP,
        unset="the end of the log",
    )
    joint_topic: tuple[str, ...] = option(
        (),
        "JointState topic; several are merged by stamp.",
        group=GROUP,
        unset="the only one named joint_states",
    )
    imu_topic: tuple[str, ...] = option((), "Imu topic.", group=GROUP, unset="all of them")
    wrench_topic: tuple[str, ...] = option(
        (),
        "WrenchStamped topic.",
        group=GROUP,
        unset="all that are named wrench; if bags of a floating robot have none and no `contact` "
        "is given, all of this type, with a warning. In bags also the topic with the frame of a "
        "`wrist_sensor`",
    )
    pose_topic: tuple[str, ...] = option(
        (),
        "Odometry or PoseStamped topic with the pose of a floating robot in the world, as from "
        "motion capture. It replaces a missing IMU. Beside an IMU it is used for link lengths "
        "and joint axes, if `sensor_errors` names these.",
        group=GROUP,
    )
    wheel_topic: tuple[str, ...] = option(
        (),
        "Topic of a wheeled base's Odometry, or of an Imu on it. The base counts as fixed while "
        "it is parked; periods of driving are left out.",
        group=GROUP,
    )
    pose_frame: str = option(
        "",
        "Frame of the robot that `pose_topic` tracks.",
        group=MAPPING,
        unset="child_frame_id of an Odometry",
    )
    plate_link: tuple[str, ...] = option(
        (),
        "Topic of a wrench in axes of the world, and the link that it acts on, such as "
        "/plate_1/wrench:=left_foot.",
        group=MAPPING,
        unset="the link that `pose_frame` is fixed to",
    )
    contact_flag: tuple[str, ...] = option(
        (),
        "Bool topic that is true while a contact touches something, and the frame of this contact "
        "in `contact`, such as /left_foot/contact:=left_sole.",
        group=MAPPING,
        unset="contacts may touch something at any time",
    )
    frame_prefix: str = option(
        "",
        "Prefix of frame names in the log that the model lacks, such as robot1/.",
        group=MAPPING,
    )
    rename_frame: tuple[str, ...] = option(
        (),
        "Frame in the log and its name in the model, such as imu_sensor:=imu_link.",
        group=MAPPING,
    )
    rename_joint: tuple[str, ...] = option(
        (),
        "Joint in the log and its name in the model, such as j1:=shoulder_pan_joint.",
        group=MAPPING,
    )
    flip_joint: tuple[str, ...] = option(
        (),
        "Joint whose positions and velocities in the log have the opposite sign of the model's.",
        group=MAPPING,
    )
    hold_joint: tuple[str, ...] = option(
        (),
        "Joint that is not recorded and its constant position in rad (m), such as "
        "wrist_joint:=0.5.",
        group=MAPPING,
        unset="joints that a bag lacks are held at 0, with a warning, unless the bag has joints "
        "that the model lacks",
    )
    position_scale: tuple[str, ...] = option(
        (),
        "Joint and the factor from its positions and velocities to rad (m), such as "
        "elbow_joint:=0.0174533 for degrees.",
        group=MAPPING,
    )
    effort_scale: tuple[str, ...] = option(
        (),
        "Joint and the factor from its efforts to Nm (N), such as elbow_joint:=-0.11 for a "
        "current.",
        group=MAPPING,
    )
    flip_wrench: tuple[str, ...] = option(
        (),
        "Frame of a wrench sensor that reads the wrench of the robot on its environment.",
        group=MAPPING,
    )
    rotate_imu: tuple[str, ...] = option(
        (),
        "Frame of an IMU, and roll, pitch and yaw in degrees of the sensor's axes in it, such as "
        "imu_link:=180,0,90.",
        group=MAPPING,
    )

    of_robot: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
        if self.stop is not None and self.stop <= self.start:
            raise OptionError(
                f"`stop` {self.stop:g} s is not after `start` {self.start:g} s; give a later one",
                "E502",
            )

    def of_same_robot(self, others: Mapping[str, Any]) -> "LogOptions":
        """Return the options with those of another log of the same robot where none are given.

        Parameters
        ----------
        others : mapping of str to object
            Values of options by name; those of the part of the log are not used.
        """
        missing = {
            one.name: others[one.name]
            for one in options_of(type(self))
            if one.name in others.keys() - PART and getattr(self, one.name) == one.default
        }
        return replace(self, **missing, of_robot=(*self.of_robot, *missing))

    def of_any_log(self) -> "LogOptions":
        """Return the options as those of a robot, whose logs may lack some joints and frames."""
        return replace(self, of_robot=tuple(one.name for one in options_of(type(self))))

    @property
    def end(self) -> float:
        """End of the part, s; infinite for the end of the log."""
        return math.inf if self.stop is None else self.stop
