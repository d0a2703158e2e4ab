"""Options that select topics, and a part of a recording."""

import math
from dataclasses import dataclass

from symbid_ros.errors import OptionError
from symbid_ros.options import check_values, option

GROUP = "Topics and time"


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Topics and part of a recording to read.

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
        (), "WrenchStamped topic.", group=GROUP, unset="all that are named wrench"
    )
    frame_prefix: str = option(
        "",
        "Prefix of the sensors' frames that the model's frames lack, such as robot1/.",
        group=GROUP,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
        if self.stop is not None and self.stop <= self.start:
            raise OptionError(
                f"`stop` {self.stop:g} s is not after `start` {self.start:g} s; give a later one",
                "E502",
            )

    @property
    def end(self) -> float:
        """End of the part, s; infinite for the end of the log."""
        return math.inf if self.stop is None else self.stop
