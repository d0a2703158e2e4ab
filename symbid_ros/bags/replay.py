"""Read the messages of bags in order of log time, for replay."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import NamedTuple

from symbid_ros.bags.container.file_index import FileIndex, RecordedTopic, read_mcap_index
from symbid_ros.bags.container.files import join_names, list_files
from symbid_ros.bags.container.mcap_records import advise_to_recover
from symbid_ros.bags.container.mcap_summary import warn_of_count_mismatch
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX, read_sqlite_index
from symbid_ros.errors import BagError
from symbid_ros.messages.layout import CDR
from symbid_ros.messages.topics import Topic, describe_topics


class RecordedMessage(NamedTuple):
    """A recorded message."""

    log_time: int  # nanoseconds
    topic: str  # name as recorded
    payload: bytes  # serialised message with its encapsulation header


@dataclass(frozen=True)
class Recording:
    """Bags that are replayed as one.

    Attributes
    ----------
    source : str
        Names of the bags, for error messages.
    topics : dict of str to RecordedTopic
        All topics by name.
    start, end : int
        First and last log time, nanoseconds.
    """

    source: str
    topics: dict[str, RecordedTopic]
    start: int
    end: int
    _files: tuple[FileIndex, ...]
    _compared: set[Path] = field(default_factory=set)

    @classmethod
    def of(cls, bags: Sequence[Path]) -> "Recording":
        """Return the recording in bag folders or files, MCAP or SQLite.

        Raises
        ------
        BagError
            When a bag is missing, damaged or empty, or a topic has two types.
        """
        source = join_names(bags)
        files = tuple(file for bag in bags for file in _read_indices(bag))
        topics: dict[str, RecordedTopic] = {}
        for topic in (topic for file in files for topic in file.topics.values()):
            known = topics.setdefault(topic.name, topic)
            if known.msgtype != topic.msgtype:
                raise BagError(
                    f"{source}: topic {topic.name} is both {known.msgtype} and {topic.msgtype}; "
                    "give the bags separately",
                    "E211",
                )
        extents = [extent for file in files for extent in file.extents]
        if not extents:
            raise BagError(f"{source}: no message in it; record it again", "E213")
        start, end = min(extent.start for extent in extents), max(extent.end for extent in extents)
        return cls(source, topics, start, end, files)

    def find(self, names: Sequence[str]) -> tuple[RecordedTopic, ...]:
        """Return the named topics; a leading slash may be omitted.

        Raises
        ------
        BagError
            When there is no such topic.
        """
        by_name = {name.lstrip("/"): topic for name, topic in self.topics.items()}
        for name in names:
            if name.lstrip("/") not in by_name:
                held = describe_topics(
                    Topic(topic.name, topic.msgtype) for topic in self.topics.values()
                )
                raise BagError(
                    f"{self.source}: no topic {name}, it holds {held}; name one of these", "E210"
                )
        return tuple(dict.fromkeys(by_name[name.lstrip("/")] for name in names))

    def require_cdr(self, topic: RecordedTopic) -> None:
        """Raise BagError if a topic's messages are not in ROS 2's encoding, CDR."""
        if topic.encoding != CDR:
            raise BagError(
                f"{self.source}: messages on {topic.name} are encoded as "
                f"{topic.encoding or 'nothing known'}, not {CDR}; leave the topic out",
                "E217",
            )

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Yield the messages of some topics with start ≤ log time < stop, by log time.

        Equal times keep the order of recording. Only chunks with overlapping times are in memory
        together. A warning names each file that was read completely and has a wrong summary.
        """
        extents = sorted(
            (
                (extent, number)
                for number, file in enumerate(self._files)
                for extent in file.extents
                if extent.start < stop and start <= extent.end
            ),
            key=lambda place: (place[0].start, place[1], place[0].offset),
        )
        unread = [len(file.extents) for file in self._files]
        counts: list[Counter[int]] = [Counter() for _ in self._files]
        waiting: list[RecordedMessage] = []
        for extent, number in extents:
            ready = bisect_left(waiting, extent.start, key=itemgetter(0))
            yield from waiting[:ready]
            file = self._files[number]
            names = {c: topic.name for c, topic in file.topics.items() if topic.name in topics}
            stored = file.messages(extent)
            unread[number] -= 1
            counts[number].update(message.channel for message in stored)
            waiting = waiting[ready:] + [
                RecordedMessage(message.log_time, names[message.channel], message.payload)
                for message in stored
                if message.channel in names and start <= message.log_time < stop
            ]
            waiting.sort(key=attrgetter("log_time"))
        yield from waiting
        for file, left, found in zip(self._files, unread, counts, strict=True):
            if not left and file.file not in self._compared:
                self._compared.add(file.file)
                warn_of_count_mismatch(file.file, file.statistics, found)


def _read_indices(bag: Path) -> list[FileIndex]:
    with advise_to_recover(bag):
        return [
            (read_sqlite_index if file.suffix == SQLITE_SUFFIX else read_mcap_index)(file)
            for file in list_files(bag)
        ]
