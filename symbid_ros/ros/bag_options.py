"""Options of recording and replay, from which the parameters of the two nodes are generated."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from symbid_ros.errors import OptionError
from symbid_ros.options import check_values, option

SENSORS = "joint_states", "imu/data", "left_foot/wrench", "right_foot/wrench"
TRUTH = "ground_truth/joints", "ground_truth/odom", "ground_truth/base_accel"


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """Which topics to record, and how to write the bag.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    bag: Path | None = option(
        None, "Folder of the new bag.", unset="log_<date>-<time> in the current folder"
    )
    topics: tuple[str, ...] = option(
        (*SENSORS, *TRUTH), "Topics to record, each as soon as it has a publisher."
    )
    all_topics: bool = option(False, "Record all other topics that are not hidden as well.")
    topics_regex: str = option(
        "", "Also record topics whose full name contains a match of this regular expression."
    )
    exclude_regex: str = option(
        "", "Do not record topics whose full name contains a match of this regular expression."
    )
    queue_depth: int = option(
        5000, "Length of each topic's queue in the middleware.", unit="messages", minimum=1
    )
    queue_size: int = option(
        256,
        "Size of the queue of messages that wait for the disk. When it is full, the topic with "
        "the most bytes in it loses messages.",
        unit="MB",
        minimum=1,
    )
    flush_period: float = option(
        0.05,
        "Longest time until data are written; a killed recorder loses only newer data.",
        unit="s",
        minimum=0.01,
        maximum=10.0,
    )
    sync_period: float = option(
        0.5,
        "Time between two syncs to the disk; a power cut loses only newer data.",
        unit="s",
        minimum=0.05,
        maximum=3600.0,
    )
    split_size: int = option(
        0, "Size after which a new file is started; 0: never.", unit="MB", minimum=0
    )
    split_duration: float = option(
        0.0, "Time after which a new file is started; 0: never.", unit="s", minimum=0.0
    )
    stop_when_silent: float = option(
        0.0,
        "Stop when no message has arrived for this time since the last one; 0: never.",
        unit="s",
        minimum=0.0,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
        for name in ("topics_regex", "exclude_regex"):
            try:
                re.compile(getattr(self, name))
            except re.error as error:
                raise OptionError(
                    f"`{name}`: invalid regular expression ({error}); give one such as ^/camera/",
                    "E501",
                ) from error


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Which part of which bags to replay, and how fast.

    Raises
    ------
    OptionError
        When a value is invalid, or two options contradict each other.
    """

    bag: tuple[Path, ...] = option((), "Bags to replay, merged by log time.")
    rate: float = option(
        1.0,
        "Speed, in seconds of the bag per second; 0: as fast as reliable subscribers acknowledge.",
        minimum=0.0,
        maximum=1000.0,
    )
    loop: bool = option(False, "Restart at the end of the bag; stamps then jump back.")
    start: float = option(
        0.0, "Start, counted from the first message of the bag.", unit="s", minimum=0.0
    )
    duration: float = option(
        0.0, "Length of the part to replay; 0: to the end of the bag.", unit="s", minimum=0.0
    )
    topics: tuple[str, ...] = option(
        (), "Topics to replay.", unset="all of installed types except /clock"
    )
    exclude: tuple[str, ...] = option((), "Topics not to replay.")
    publish_clock: bool = option(False, "Publish /clock for nodes that set use_sim_time.")
    clock_rate: float = option(
        100.0,
        "Rate of /clock, in messages per second of the bag.",
        unit="Hz",
        minimum=0.1,
        maximum=10000.0,
    )
    clock_source: Literal["header", "log"] = option(
        "header", "Time on /clock. header: the newest header stamp replayed; log: the log time."
    )
    wait_for_subscribers: bool = option(
        False,
        "Start when every sensor topic has a subscriber, or every topic if none is a sensor's.",
    )
    lossless: bool = option(
        True,
        "Wait for slow reliable subscribers instead of dropping messages. A `rate` of 0 always "
        "waits.",
    )
    queue_depth: int = option(
        5000,
        "Messages kept for slow subscribers if not `lossless`.",
        unit="messages",
        minimum=1,
    )

    def __post_init__(self) -> None:
        """Refuse options that are invalid or contradict each other."""
        check_values(self)
        if not self.bag:
            raise OptionError("`bag`: empty; give at least one bag", "E501")
        if self.publish_clock and "clock" in (name.lstrip("/") for name in self.topics):
            raise OptionError(
                "`topics`: `publish_clock` also publishes /clock; remove /clock from `topics` or "
                "set `publish_clock` to false",
                "E502",
            )
