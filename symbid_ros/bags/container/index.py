"""Where the messages of a file are, so that they can be read in order of time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Statistics

from symbid_ros.bags.container.catalogue import Catalogue, full_name
from symbid_ros.bags.metadata import OfferedQos

EXTENT_SIZE = 1 << 20  # bytes of messages, other than chunks, that are read together


@dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes
    ----------
    name, msgtype : str
    encoding : str
        Message encoding; ROS 2 uses ``cdr``.
    qos : tuple of OfferedQos
        What its publishers offered; empty if the bag does not say.
    """

    name: str
    msgtype: str
    encoding: str
    qos: tuple[OfferedQos, ...]


class Extent(NamedTuple):
    """Consecutive records of a file, such as a chunk, that hold messages.

    Attributes
    ----------
    start, end : int
        First and last log time, nanoseconds.
    offset, length : int
        Bytes of an MCAP file, rows of an SQLite table.
    """

    start: int
    end: int
    offset: int
    length: int


class StoredMessage(NamedTuple):
    """A message of a file: log time in nanoseconds, channel and serialised message."""

    log_time: int
    channel: int
    payload: bytes


@dataclass(frozen=True)
class FileIndex:
    """The topics of a file, and where its messages are.

    Attributes
    ----------
    file : Path
    topics : mapping of int to RecordedTopic
        By channel.
    extents : tuple of Extent
        In any order; their times may overlap.
    statistics : mcap Statistics or None
        Message counts stated by the file.
    messages : callable
        Returns the messages of an extent, in order of recording.
    """

    file: Path
    topics: Mapping[int, RecordedTopic]
    extents: tuple[Extent, ...]
    statistics: Statistics | None
    messages: Callable[[Extent], list[StoredMessage]]


def recorded_topics(catalogue: Catalogue) -> dict[int, RecordedTopic]:
    """Return the topics of a file by channel."""
    return {
        number: RecordedTopic(
            name=channel.topic,
            msgtype=full_name(schema.name) if (schema := catalogue.schema(channel)) else "",
            encoding=channel.message_encoding,
            qos=catalogue.offers(channel),
        )
        for number, channel in catalogue.channels.items()
    }
