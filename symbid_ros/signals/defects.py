"""Defects of messages and their header stamps, counted per topic for one warning each."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, distinct
from symbid_ros.errors import DataError

logger = logging.getLogger("symbid_ros.bags")

CLOCK_JUMP = 1_000_000_000  # ns; messages overtake one another by milliseconds only
# Larger numbers, in any unit, are not readings. Damaged files hold such numbers.
LARGEST = 1e9
# Root mean square of regular intervals' deviations, in periods, from which long ones may be jitter.
JITTER = 0.1
# Messages on either side of such an interval that tell jitter from a loss, and periods that their
# mean delay may change without one, as near the ends of a log.
NEIGHBOURS, MARGIN = 20, 0.24
# Numbers of messages over which intervals are averaged, and the ratio of averages to single ones
# from which these are bursts.
SPANS, BURSTS = (1, 2, 4, 8, 16, 32, 64), 1.5
ALWAYS = (-(2**62), 2**62)  # ns; beyond every clock, with room for margins


class Defect(Enum):
    """What may be wrong with messages; the value completes "3 of 100 messages …"."""

    DISORDER = "are out of order and were sorted"
    DUPLICATE = "repeat a stamp and were dropped"
    NOT_FINITE = "have no usable {} and were dropped"
    SPIKE = "have a spike in {}, the first at {first}, and were dropped"
    UNKNOWN_JOINT = "name joints that most messages do not and were dropped"
    REORDERED_JOINTS = "name their joints in a different order and were reordered"
    OTHER_JOINTS = "name only other joints and were dropped"
    NO_NAMES = "name no joint"
    NO_ORIENTATION = "have no orientation"
    LATE = "arrived after their block had been processed and were dropped"
    OTHER_LAYOUT = "have irregular bytes and were decoded one by one"
    CLOCK_JUMP = "jump back"
    OTHER_FRAME = "change their frame"
    ABSENT = "mark a reading absent"
    NAMED_TWICE = "name a joint twice"


class DefectError(DataError):
    """Messages of one topic with a defect that cannot be repaired.

    Attributes
    ----------
    topic : str
    defect : Defect
    """

    def __init__(self, topic: str, defect: Defect, message: str, code: str) -> None:
        super().__init__(message, code)
        self.topic, self.defect = topic, defect


@dataclass
class DefectCounts:
    """Number of defective messages of one topic.

    Attributes
    ----------
    source, topic : str
        Names of the log and of the topic.
    during : (int, int)
        Only messages with a stamp from the first up to the second, ns, are counted. A log that is
        read in overlapping slices is thus counted once.
    messages : int
        All messages.
    counts : dict of Defect to int
        Messages with each defect.
    details : dict of Defect to list of str
        Fields or joints that have the defect.
    first : dict of Defect to int
        Stamp of the first message with each defect, ns.
    """

    source: str
    topic: str
    during: tuple[int, int] = ALWAYS
    messages: int = 0
    counts: dict[Defect, int] = field(default_factory=dict)
    details: dict[Defect, list[str]] = field(default_factory=dict)
    first: dict[Defect, int] = field(default_factory=dict)

    def count_messages(self, stamps: IntArray) -> None:
        """Count messages by their stamps (N,) ns."""
        self.messages += int(np.count_nonzero(self._is_during(stamps)))

    def add(
        self, defect: Defect, stamps: IntArray, wrong: BoolArray, where: Iterable[str] = ()
    ) -> None:
        """Count the messages (N,) marked as wrong; ``where`` names the fields or joints."""
        counted = wrong & self._is_during(stamps)
        count = int(np.count_nonzero(counted))
        if count:
            self.counts[defect] = self.counts.get(defect, 0) + count
            self.first.setdefault(defect, int(stamps[counted].min()))
            known = self.details.setdefault(defect, [])
            known += [one for one in where if one not in known]

    def description(self, defect: Defect) -> str:
        """Return the part of a warning that follows "3 of 100 messages"."""
        first = seconds(self.first.get(defect, 0))
        return defect.value.format(", ".join(self.details.get(defect, [])), first=first)

    def report(self) -> None:
        """Log one warning for each defect."""
        for defect, count in self.counts.items():
            logger.warning(
                "%s: %s: %d of %d messages %s",
                self.source,
                self.topic,
                count,
                self.messages,
                self.description(defect),
            )

    def _is_during(self, stamps: IntArray) -> BoolArray:
        start, stop = self.during
        inside: BoolArray = (stamps >= start) & (stamps < stop)
        return inside


def drop_impossible(values: FloatArray) -> FloatArray:
    """Replace numbers that no sensor reads by NaN, in place, and return the array."""
    wrong = ~(np.abs(values) <= LARGEST)
    if wrong.any():
        values[wrong] = np.nan
    return values


def seconds(stamp: int | np.int64) -> str:
    """Return a stamp as text."""
    return f"{int(stamp) / 1e9:.3f} s"


def check_clock(source: str, topic: str, stamp: IntArray) -> None:
    """Check that stamps (N,), ns in order of recording, do not jump back.

    Raises
    ------
    DefectError
        When they do, by more than a second.
    """
    step = np.diff(stamp)
    jumps = np.flatnonzero(step < -CLOCK_JUMP)
    if len(jumps):
        at = jumps[0]
        raise DefectError(
            topic,
            Defect.CLOCK_JUMP,
            f"{source}: {topic}: header stamps jump back by {seconds(-step[at])} after "
            f"{seconds(stamp[at])}; record each run in a bag of its own",
            "E314",
        )


def kept_in_order(stamp: IntArray, tally: DefectCounts) -> IntArray:
    """Return the indices (K,) of the messages to keep, by strictly increasing stamp.

    Messages out of order are sorted. Of messages with equal stamps the first is kept. Both are
    counted.

    Parameters
    ----------
    stamp : (N,) int64
        Nanoseconds, in order of recording.
    tally : DefectCounts
        Counts of the topic.
    """
    check_clock(tally.source, tally.topic, stamp)
    order: IntArray = np.argsort(stamp, kind="stable")
    repeated = np.concatenate([[False], np.diff(stamp[order]) == 0])
    if len(stamp) > 1 and repeated[1:].all():
        raise DefectError(
            tally.topic,
            Defect.DUPLICATE,
            f"{tally.source}: {tally.topic}: all header stamps are {seconds(stamp[0])}; "
            "let the driver fill header.stamp",
            "E315",
        )
    tally.add(Defect.DISORDER, stamp[1:], np.diff(stamp) < 0)
    tally.add(Defect.DUPLICATE, stamp[order], repeated)
    kept: IntArray = order[~repeated]
    return kept


def typical_period(stamps: IntArray) -> float:
    """Return the median interval between increasing stamps (N,), ns; 0 for fewer than two.

    Where single intervals vary, as with jitter, intervals over several messages are divided by
    their number: if stamps jitter by periods, most single intervals are shorter than the mean. So
    they are where messages arrive in bursts.
    """
    if len(stamps) < 2:
        return 0.0
    spans = [span for span in SPANS if span == 1 or 4 * span <= len(stamps)]
    longest = float(np.median(_steps(stamps, spans[-1])))
    for span in spans[:-1]:
        steps = _steps(stamps, span)
        period = float(np.median(steps))
        varies = np.median(np.abs(steps - period)) >= JITTER * period
        if not varies and longest < BURSTS * period:
            return period
    return longest


def _steps(stamps: IntArray, span: int) -> FloatArray:
    """Return the intervals over ``span`` messages, divided by it."""
    steps: FloatArray = (stamps[span:] - stamps[:-span]) / span
    return steps


@dataclass(frozen=True)
class Gaps:
    """Gaps of one topic.

    Attributes
    ----------
    period : int
        Median interval between stamps, ns; 0 for fewer than two messages.
    gaps, missing : int
        Intervals that lack messages, and the number of these, see :class:`Intervals`.
    longest : int
        Longest interval, ns.
    disordered : int
        Stamps that are not later than the previous one.
    """

    period: int
    gaps: int
    missing: int
    longest: int
    disordered: int


@dataclass(frozen=True)
class Intervals:
    """Intervals between the stamps of one topic, and the messages that they lack.

    Attributes
    ----------
    stamps : (N,) int64
        Distinct stamps in ascending order, ns.
    period : int
        Median interval, ns; 0 for fewer than two stamps.
    missing : (max(N - 1, 0),) int64
        Number of messages that would fill each interval of at least 1.5 periods. Messages that
        repeat the stamp at either end are not missing: they have the wrong stamp. Nor are any if
        messages before came earlier, or those behind come later, than one period apart, as with
        jitter.
    """

    stamps: IntArray
    period: int
    missing: IntArray

    @classmethod
    def between(cls, stamps: IntArray) -> "Intervals":
        """Return the intervals between stamps (M,), ns in any order."""
        ordered = distinct(stamps)
        step = np.diff(ordered)
        if not len(step):
            return cls(ordered, 0, np.zeros(0, dtype=np.int64))
        period = int(typical_period(ordered))
        missing = np.where(2 * step >= 3 * period, np.rint(step / period) - 1, 0).astype(np.int64)
        long = np.flatnonzero(missing)
        regular = step[2 * step < 3 * period] / period - 1
        if len(long) and len(regular) and np.sqrt(np.mean(regular**2)) > JITTER:
            missing[long] = np.minimum(missing[long], _lost_at(long, ordered, period))
        if len(ordered) < len(stamps):
            spare = np.bincount(np.searchsorted(ordered, stamps)) - 1
            for index in np.flatnonzero((missing > 0) & (spare[:-1] + spare[1:] > 0)).tolist():
                for end in (index, index + 1):
                    moved = min(missing[index], spare[end])
                    missing[index] -= moved
                    spare[end] -= moved
        return cls(ordered, period, missing)

    @property
    def steps(self) -> IntArray:
        """Lengths of the intervals, ns."""
        return np.diff(self.stamps)


def _lost_at(intervals: IntArray, stamps: IntArray, period: int) -> IntArray:
    """Return by how many periods messages behind some intervals (k,) are late for good.

    A lost message delays all that follow. Jitter delays single ones, which the means of the
    neighbours' delays hardly contain. A loss delays the neighbours of intervals nearby as well, so
    that of these only the one with the largest delay counts.
    """
    late = stamps - stamps[0] - period * np.arange(len(stamps))
    near, last = np.arange(NEIGHBOURS), len(stamps) - 1
    before = np.mean(late[np.maximum(intervals[:, None] - near, 0)], axis=1)
    after = np.mean(late[np.minimum(intervals[:, None] + 1 + near, last)], axis=1)
    delays = np.zeros(last)
    delays[intervals] = delay = (after - before) / period
    around = intervals[:, None] + np.arange(-(NEIGHBOURS // 2), NEIGHBOURS // 2 + 1)
    is_largest = delay >= delays[np.clip(around, 0, last - 1)].max(axis=1)
    return np.where(is_largest, np.maximum(np.rint(delay - MARGIN), 0), 0).astype(np.int64)


def find_gaps(stamps: IntArray) -> Gaps:
    """Find the gaps in stamps (N,), ns in order of arrival."""
    disordered = int(np.count_nonzero(np.diff(stamps) <= 0))
    found = Intervals.between(stamps)
    missing, longest = found.missing, int(found.steps.max(initial=0))
    return Gaps(
        found.period, int(np.count_nonzero(missing)), int(missing.sum()), longest, disordered
    )
