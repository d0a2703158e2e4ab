"""Recover an interrupted or damaged bag into an indexed one, and report what is lost."""

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata, Statistics

from symbid_ros.bags.container.files import find_files, list_file_names, read_metadata
from symbid_ros.bags.container.mcap_records import (
    MESSAGE,
    PAYLOAD_OFFSET,
    RECORD,
    Attachment,
    identify_other_format,
    read_parts,
    report_damage,
)
from symbid_ros.bags.container.mcap_summary import read_summary
from symbid_ros.bags.container.schema_registry import SchemaRegistry
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX
from symbid_ros.bags.recovery.damaged_mcap import (
    DamagedMcapReader,
    DamagedRange,
    MessageRun,
    PrivateRecord,
)
from symbid_ros.bags.recovery.report import LostRange, RecoveryCounts, RecoveryReport
from symbid_ros.bags.recovery.rewriter import ROSBAG2, BagRewriter
from symbid_ros.bags.recovery.sqlite_recovery import recover_sqlite
from symbid_ros.bags.writing.bag_file import create_folder
from symbid_ros.errors import BagError
from symbid_ros.messages.topics import Topic

MESSAGE_MODE = "MESSAGE"


def recover(bag: Path, out: Path | None = None) -> RecoveryReport:
    """Copy the intact messages of a bag into a new one.

    Parameters
    ----------
    bag : Path
        A bag's folder or one of its files, finished or not; it is not changed.
    out : Path, optional
        Folder of the new bag, which must not exist. Default: the bag's name with ``_recovered``.

    Raises
    ------
    BagError
        When there is no such bag, nothing in it can be recovered, or writing fails.
    """
    files = find_files(bag)
    for file in files:
        if file.suffix == SQLITE_SUFFIX:
            continue
        with report_damage(file):
            kind = identify_other_format(file)
        if kind and len(files) == 1:
            raise BagError(f"{file}: {kind}", "E204")
    place = bag if bag.name not in ("", "..") else bag.resolve()  # as the user named it
    target = out or place.with_name(f"{place.stem if bag.is_file() else place.name}_recovered")
    mode = _compression_mode(bag)
    with create_folder(target) as folder, BagRewriter(folder, mode) as new:
        counts = RecoveryCounts()
        for file in files:
            counts.begin_file()
            if not file.stat().st_size:
                counts.add_hole(LostRange(file.name, 0, 0, "empty"))
                counts.is_counted = False
            elif file.suffix == SQLITE_SUFFIX:
                recover_sqlite(file, new, counts)
            else:
                McapRecovery(file, new, counts).run()
            new.end_file()
        _add_stated_counts(bag, files, counts)
        if not counts.kept.total() and not counts.records.total():
            raise BagError(f"{bag}: nothing in it can be recovered; use another copy", "E221")
        new.finish()
    return counts.report(bag, target)


def _compression_mode(bag: Path) -> str:
    """Return how rosbag2 compressed the messages, which are copied as they are."""
    with suppress(BagError):
        mode = str(read_metadata(bag / "metadata.yaml").get("compression_mode", "")).upper()
        return mode if mode == MESSAGE_MODE else ""
    return ""


def _add_stated_counts(bag: Path, files: list[Path], counts: RecoveryCounts) -> None:
    """Add missing files and messages that only metadata.yaml states.

    rosbag2 writes it when the recording ends.
    """
    try:
        information = read_metadata(bag / "metadata.yaml")
        stated = {
            Topic(str(entry["topic_metadata"]["name"]), str(entry["topic_metadata"]["type"])): int(
                entry["message_count"]
            )
            for entry in information["topics_with_message_count"]
        }
    except (BagError, KeyError, TypeError, ValueError):
        return
    missing = {*list_file_names(information)} - {file.name for file in files}
    counts.holes += [LostRange(name, 0, 0, "no such file") for name in sorted(missing)]
    names = {topic.name: topic for topic in counts.stated}
    for topic, count in stated.items():
        known = names.get(topic.name, topic)
        counts.stated[known] = max(counts.stated[known], count)
    # A metadata.yaml that counts fewer messages than were found is outdated.
    counts.is_counted |= sum(stated.values()) >= counts.kept.total()


@dataclass
class McapRecovery:
    """Copies the intact messages of one MCAP file."""

    file: Path
    new: BagRewriter
    counts: RecoveryCounts
    registry: SchemaRegistry = field(default_factory=SchemaRegistry)
    found: Counter[int] = field(default_factory=Counter)
    kept: Counter[int] = field(default_factory=Counter)
    targets: dict[int, int] = field(default_factory=dict)
    records: Counter[int] = field(default_factory=Counter)

    def run(self) -> None:
        """Copy and count all intact messages of the file."""
        statistics = self._statistics()
        lost: Counter[int] = Counter()
        reader = DamagedMcapReader(self.file, self.registry)
        for part in reader.parts():
            if isinstance(part, DamagedRange):
                lost.update(part.messages)
                self.counts.is_counted &= part.is_counted or statistics is not None
                self.counts.add_hole(
                    LostRange(
                        self.file.name,
                        part.offset,
                        part.length,
                        part.fault,
                        messages=sum(part.messages.values()),
                        is_counted=part.is_counted,
                    )
                )
            elif isinstance(part, Metadata | Attachment):
                self._copy_record(part)
            elif isinstance(part, PrivateRecord):
                with self.file.open("rb") as stream:
                    self.new.add_private(read_parts(stream, *part))
            elif len(part.starts):
                self._copy(part)
        self._count_records(statistics, reader.damaged)
        stated = self.found + lost if statistics is None else statistics.channel_message_counts
        for channel, count in stated.items():
            self.counts.stated[self._topic(channel)] += count
        for channel, count in self.kept.items():
            self.counts.kept[self._topic(channel)] += count
        self.counts.repeated += reader.repeated
        for channel in self.registry.channels:
            self._target(channel)  # also topics without messages

    def _statistics(self) -> Statistics | None:
        """Return the statistics of an intact summary, and keep its channels."""
        with suppress(BagError), report_damage(self.file):
            summary = read_summary(self.file)
            self.registry = summary.registry
            stated = summary.statistics
            # Writers may omit the counts by channel.
            if stated is not None and stated.message_count == sum(
                stated.channel_message_counts.values()
            ):
                return stated
        return None

    def _count_records(self, stated: Statistics | None, damaged: Counter[int]) -> None:
        totals = damaged + self.records
        if stated is not None:
            totals = Counter(
                {Opcode.ATTACHMENT: stated.attachment_count, Opcode.METADATA: stated.metadata_count}
            )
        for opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.counts.records_lost[opcode] += max(0, totals[opcode] - self.records[opcode])

    def _copy_record(self, record: Metadata | Attachment) -> None:
        """Copy an attachment or metadata record, except rosbag2's own, which is rewritten."""
        kind = Opcode.ATTACHMENT if isinstance(record, Attachment) else Opcode.METADATA
        self.records[kind] += 1
        if isinstance(record, Attachment):
            with self.file.open("rb") as stream:
                self.new.add_attachment(record, stream)
        elif record.name != ROSBAG2:
            self.new.add_metadata(record)
        else:
            return
        self.counts.records[kind] += 1

    def _copy(self, run: MessageRun) -> None:
        """Copy messages."""
        data = run.data
        first, last = 1 << 64, 0
        for start in run.starts:
            _, length = RECORD.unpack_from(data, start)
            channel, sequence, log_time, publish_time = MESSAGE.unpack_from(
                data, start + RECORD.size
            )
            first, last = min(first, log_time), max(last, log_time)
            self.found[channel] += 1
            target = self._target(channel)
            if target is not None:
                payload = bytes(data[start + PAYLOAD_OFFSET : start + RECORD.size + length])
                self.new.write(target, log_time, publish_time, payload, sequence)
                self.kept[channel] += 1
        self.counts.add_kept_times(first, last)

    def _target(self, channel: int) -> int | None:
        """Return the channel in the new bag; None if it was never announced."""
        if channel not in self.targets:
            known = self.registry.channels.get(channel)
            if known is None:  # a later record may announce it
                return None
            self.targets[channel] = self.new.channel(self.registry, known)
        return self.targets[channel]

    def _topic(self, channel: int) -> Topic:
        known = self.registry.channels.get(channel)
        if known is None:
            return Topic(f"(unknown channel {channel})", "")
        return self.registry.topic(known)
