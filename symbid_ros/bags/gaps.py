"""What header stamps tell of lost messages."""

import struct
from dataclasses import dataclass

import numpy as np
from rosbags.interfaces import Nodetype

from symbid_ros.arrays import IntArray
from symbid_ros.bags.layout import ENCAPSULATION, typestore

HEADER = (Nodetype.NAME, "std_msgs/msg/Header")
TIME = (Nodetype.NAME, "builtin_interfaces/msg/Time")
_STAMP = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}


@dataclass(frozen=True)
class Gaps:
    """How complete a topic is.

    Attributes
    ----------
    period : int
        Median distance of successive stamps, nanoseconds; 0 below two messages.
    gaps, missing : int
        Distances of 1.5 periods and more, and the messages that would fill them.
    longest : int
        Largest distance, nanoseconds.
    disordered : int
        Stamps not later than the one before.
    """

    period: int
    gaps: int
    missing: int
    longest: int
    disordered: int


def find_gaps(stamps: IntArray) -> Gaps:
    """Judge the stamps (N,) of one topic, nanoseconds in order of arrival."""
    disordered = int(np.count_nonzero(np.diff(stamps) <= 0))
    step = np.diff(np.unique(stamps))
    if not len(step):
        return Gaps(0, 0, 0, 0, disordered)
    period = int(np.median(step))
    wide = step[2 * step >= 3 * period]
    missing = int(np.sum(np.rint(wide / period) - 1))
    return Gaps(period, len(wide), missing, int(step.max()), disordered)


def has_stamp(msgtype: str) -> bool:
    """Tell whether messages of a type begin with a header or a time."""
    fields = typestore().fielddefs[msgtype][1]
    return bool(fields) and fields[0][1] in (HEADER, TIME)


def stamp_of(payload: bytes) -> int:
    """Return the leading stamp of a serialised message, nanoseconds."""
    seconds, nanoseconds = _STAMP[payload[1] & 1].unpack_from(payload, ENCAPSULATION)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
