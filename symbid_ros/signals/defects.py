"""What was mended in a topic's messages, counted, so that one warning can tell it."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from symbid_ros.arrays import BoolArray, IntArray
from symbid_ros.errors import UNCODED, DataError

logger = logging.getLogger("symbid_ros.bags")

ALWAYS = (-(2**62), 2**62)  # ns; far beyond every clock, and room for margins


class Defect(Enum):
    """What may be wrong with messages; the value is how a warning goes on after their number."""

    DISORDER = "are out of order, sorted"
    DUPLICATE = "repeat a stamp, dropped"
    NOT_FINITE = "have no finite {}, left out"
    UNKNOWN_JOINT = "name joints that most do not, left out"
    REORDERED_JOINTS = "name their joints in another order than the first, put in that order"
    OTHER_JOINTS = "name other joints alone, left out"
    NO_NAMES = "name no joint"
    NO_ORIENTATION = "have no orientation"
    LATE = "came after their time had been worked on, left out"
    OTHER_LAYOUT = "were decoded one by one, their bytes follow no layout"
    CLOCK_JUMP = "jump back"
    OTHER_FRAME = "change their frame"
    ABSENT = "mark a reading absent"
    NAMED_TWICE = "name a joint twice"


class DefectError(DataError):
    """Messages of one topic that cannot be mended.

    Attributes
    ----------
    topic : str
    defect : Defect
    """

    def __init__(self, topic: str, defect: Defect, message: str, code: str = UNCODED) -> None:
        super().__init__(message, code)
        self.topic, self.defect = topic, defect


@dataclass
class DefectCounts:
    """Counts of one topic.

    Attributes
    ----------
    source, topic : str
        Names of the bag and of the topic.
    during : (int, int)
        Only messages with a stamp from the first up to the second, ns, are counted: who reads a
        log in pieces that overlap counts nothing twice.
    messages : int
        Messages seen.
    counts : dict of Defect to int
        Of these, by what is wrong with them.
    details : dict of Defect to list of str
        Where in them it is wrong.
    """

    source: str
    topic: str
    during: tuple[int, int] = ALWAYS
    messages: int = 0
    counts: dict[Defect, int] = field(default_factory=dict)
    details: dict[Defect, list[str]] = field(default_factory=dict)

    def see(self, stamps: IntArray) -> None:
        """Count messages by their stamps (N,), ns."""
        self.messages += int(np.count_nonzero(self._is_during(stamps)))

    def add(
        self, defect: Defect, stamps: IntArray, wrong: BoolArray, where: Iterable[str] = ()
    ) -> None:
        """Count those of the messages (N,) that are wrong."""
        count = int(np.count_nonzero(wrong & self._is_during(stamps)))
        if count:
            self.counts[defect] = self.counts.get(defect, 0) + count
            known = self.details.setdefault(defect, [])
            known += [one for one in where if one not in known]

    def told(self, defect: Defect) -> str:
        """Return what a warning says of messages with a defect, after their number."""
        return defect.value.format(", ".join(self.details.get(defect, [])))

    def report(self) -> None:
        """Warn of what was counted."""
        for defect, count in self.counts.items():
            logger.warning(
                "%s: %s: %d of %d messages %s",
                self.source,
                self.topic,
                count,
                self.messages,
                self.told(defect),
            )

    def _is_during(self, stamps: IntArray) -> BoolArray:
        start, stop = self.during
        inside: BoolArray = (stamps >= start) & (stamps < stop)
        return inside
