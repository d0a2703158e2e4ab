"""Describe a bag: its files, topics and times, even if its recording was interrupted."""

from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Header, Metadata, Statistics

from symbid_ros.bags.container.files import find_files, read_metadata
from symbid_ros.bags.container.mcap_records import (
    MAGIC,
    MESSAGE,
    RECORD,
    Attachment,
    advise_to_recover,
    checked_size,
    report_damage,
)
from symbid_ros.bags.container.mcap_summary import McapSummary, read_summary
from symbid_ros.bags.container.schema_registry import SchemaRegistry, parse_record
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX, read_sqlite_summary
from symbid_ros.bags.recovery.damaged_mcap import DamagedMcapReader, MessageRun
from symbid_ros.errors import BagError
from symbid_ros.json_documents import versioned, with_keys
from symbid_ros.messages.limits import MAX_QOS, check_limit
from symbid_ros.messages.topics import OfferedQos, Topic

# Fields and their keys in JSON, with units.
_KEYS = {"size": "size_bytes", "start": "start_ns", "end": "end_ns", "rate": "rate_hz"}


@dataclass(frozen=True)
class FileInfo:
    """One file of a bag."""

    name: str
    size: int  # bytes
    storage: str  # mcap or sqlite3
    is_finished: bool  # whether it has a footer
    is_indexed: bool  # whether it has an index of its messages
    start: int | None  # first log time, nanoseconds; None without a message
    end: int | None  # last log time, nanoseconds; None without a message
    counts: dict[Topic, int]  # messages
    compression: tuple[str, ...] = ()  # of its chunks; empty if not compressed or unknown
    recorded_by: str = ""  # library that wrote it, if the file states it
    fault: str = ""  # the fault and its fix; empty for an intact file
    attachments: int = 0  # number of these records
    metadata: int = 0


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag."""

    name: str
    msgtype: str
    count: int  # messages
    rate: float | None  # messages per second of the bag; None if its duration is zero
    qos: tuple[OfferedQos, ...]  # offered by the publishers


@dataclass(frozen=True)
class BagInfo:
    """A bag: its files in order, topics by name, first and last log time in nanoseconds."""

    bag: Path
    files: tuple[FileInfo, ...]
    topics: tuple[TopicInfo, ...]
    start: int | None
    end: int | None
    ros_distro: str

    @property
    def size(self) -> int:
        """Total bytes of the files."""
        return sum(file.size for file in self.files)

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.topics)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last message."""
        return 0.0 if self.start is None or self.end is None else (self.end - self.start) * 1e-9

    @property
    def is_finished(self) -> bool:
        """Whether all files have a footer."""
        return all(file.is_finished for file in self.files)

    def as_dict(self) -> dict[str, Any]:
        """Return the output of ``symbid bag info --json``."""
        files = []
        for file in self.files:
            counts = {topic.name: count for topic, count in file.counts.items()}
            files.append(with_keys({**vars(file), "counts": counts}, _KEYS))
        document = {
            "bag": str(self.bag),
            "size_bytes": self.size,
            "duration_s": self.duration,
            "start_ns": self.start,
            "end_ns": self.end,
            "count": self.count,
            "is_finished": self.is_finished,
            "ros_distro": self.ros_distro,
            "files": files,
            "topics": [with_keys(asdict(topic), _KEYS) for topic in self.topics],
        }
        return versioned("bag_info", document)


def bag_info(bag: Path) -> BagInfo:
    """Describe a bag from the summaries of its files; files without one are read completely.

    Raises
    ------
    BagError
        When there is no such bag.
    """
    qos: dict[Topic, tuple[OfferedQos, ...]] = {}
    present = find_files(bag)
    files = tuple(
        _sqlite_file(file, qos)
        if file.suffix == SQLITE_SUFFIX
        else _mcap_file(file, bag, qos, is_alone=len(present) == 1)
        for file in present
    )
    counts: Counter[Topic] = Counter()
    for file in files:
        counts.update(file.counts)
    start = min((file.start for file in files if file.start is not None), default=None)
    end = max((file.end for file in files if file.end is not None), default=None)
    duration = 0 if start is None or end is None else end - start
    topics = tuple(
        TopicInfo(
            topic.name,
            topic.msgtype,
            counts[topic],
            counts[topic] / duration * 1e9 if duration else None,
            qos.get(topic, ()),
        )
        for topic in sorted(counts, key=lambda topic: topic.name)
    )
    return BagInfo(bag, files, topics, start, end, _ros_distro(bag))


def _ros_distro(bag: Path) -> str:
    try:
        return str(read_metadata(bag / "metadata.yaml").get("ros_distro") or "")
    except BagError:
        return ""


def _mcap_file(
    file: Path, bag: Path, qos: dict[Topic, tuple[OfferedQos, ...]], *, is_alone: bool
) -> FileInfo:
    fault = ""
    try:
        with advise_to_recover(bag), report_damage(file):
            summary = read_summary(file, with_chunks=True)
    except BagError as error:
        if is_alone and not _begins_with_magic(file):
            raise
        fault = str(error).removeprefix(f"{file}: ")
        summary = McapSummary(SchemaRegistry(), None, (), data_end=0, data_crc=0)
    registry = summary.registry
    stated = summary.statistics if summary.has_topic_counts else _read_statistics(file, registry)
    assert stated is not None
    counts: Counter[Topic] = Counter()
    for number, channel in registry.channels.items():
        topic = registry.topic(channel)
        counts[topic] += stated.channel_message_counts.get(number, 0)
        with suppress(ValueError):
            qos[topic] = qos.get(topic) or registry.offered_qos(channel)
    is_filled = counts.total() > 0
    return FileInfo(
        name=file.name,
        size=file.stat().st_size,
        storage="mcap",
        compression=tuple(sorted({chunk.compression for chunk in summary.chunks} - {""})),
        recorded_by=_library(file),
        is_finished=_has_footer(file),
        is_indexed=any(chunk.message_index_offsets for chunk in summary.chunks),
        fault=fault,
        start=stated.message_start_time if is_filled else None,
        end=stated.message_end_time if is_filled else None,
        counts=dict(counts),
        attachments=stated.attachment_count,
        metadata=stated.metadata_count,
    )


def _read_statistics(file: Path, registry: SchemaRegistry) -> Statistics:
    """Read a file to its end and return its actual statistics."""
    counts: Counter[int] = Counter()
    records: Counter[type] = Counter()
    first, last = 1 << 64, 0
    for part in DamagedMcapReader(file, registry).parts():
        records[type(part)] += 1
        if isinstance(part, MessageRun):
            for start in part.starts:
                channel, _, log_time, _ = MESSAGE.unpack_from(part.data, start + RECORD.size)
                counts[channel] += 1
                first, last = min(first, log_time), max(last, log_time)
    return Statistics(
        attachment_count=records[Attachment],
        channel_count=len(registry.channels),
        channel_message_counts=counts,
        chunk_count=records[MessageRun],
        message_count=counts.total(),
        message_start_time=first,
        message_end_time=last,
        metadata_count=records[Metadata],
        schema_count=len(registry.schemas),
    )


def _begins_with_magic(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def _has_footer(file: Path) -> bool:
    with suppress(BagError):
        checked_size(file)
        return True
    return False


def _library(file: Path) -> str:
    """Return which library wrote a file; empty if its first record does not state it."""
    with file.open("rb") as stream:
        stream.seek(len(MAGIC))
        head = stream.read(RECORD.size)
        if len(head) == RECORD.size and RECORD.unpack(head)[0] == Opcode.HEADER:
            with suppress(BagError), report_damage(file):
                length = check_limit("a header", RECORD.unpack(head)[1], MAX_QOS)
                return str(parse_record(Header.read, stream.read(length)).library)
    return ""


def _sqlite_file(file: Path, qos: dict[Topic, tuple[OfferedQos, ...]]) -> FileInfo:
    held = read_sqlite_summary(file)
    for topic, offers in held.qos.items():
        qos[topic] = qos.get(topic) or offers
    return FileInfo(
        name=file.name,
        size=file.stat().st_size,
        storage="sqlite3",
        is_finished=held.is_finished,
        is_indexed=True,
        start=held.start,
        end=held.end,
        counts=dict(held.counts),
    )
