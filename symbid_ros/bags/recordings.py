"""Which bags hold parts of one recording, and which hold recordings of their own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from symbid_ros.bags.container.schema_registry import DECODED_TYPES
from symbid_ros.bags.info import BagInfo, bag_info

# A recorder that splits its bags begins the next one within a fraction of a second, ns.
LONGEST_BREAK = 1_000_000_000


@dataclass
class _Recording:
    bags: list[Path]
    end: int
    topics: set[str]

    def is_continued_by(self, bag: BagInfo, start: int) -> bool:
        """Return whether a bag that begins at ``start`` is a part of this recording.

        Bags of the same time were written by several recorders if their sensors differ. Otherwise
        their clocks began alike, such as those of simulations.
        """
        if start < self.end - LONGEST_BREAK:
            return _sensor_topics(bag) != self.topics
        return start <= self.end + LONGEST_BREAK


def separate_recordings(bags: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Return the bags of each recording, in the order of time.

    Times are those at which the messages were written.

    Parameters
    ----------
    bags : sequence of Path
        In any order.

    Raises
    ------
    BagError
        When a bag is missing.
    """
    if len(bags) < 2:
        return [tuple(bags)]
    found = sorted(map(bag_info, bags), key=lambda one: one.start or 0)
    recordings: list[_Recording] = []
    for info in found:
        if info.start is None or info.end is None:  # it holds no message
            continue
        if not recordings or not recordings[-1].is_continued_by(info, info.start):
            recordings.append(_Recording([], info.end, set()))
        current = recordings[-1]
        current.bags.append(info.bag)
        current.end = max(current.end, info.end)
        current.topics |= _sensor_topics(info)
    return [tuple(one.bags) for one in recordings]


def _sensor_topics(bag: BagInfo) -> set[str]:
    """Return the topics with messages of sensors; others, such as /tf, may come and go."""
    return {one.name for one in bag.topics if one.count and one.msgtype in DECODED_TYPES}
