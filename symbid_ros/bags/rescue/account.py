"""What has been found, kept and lost while a bag is recovered."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from symbid_ros.bags.rescue.recovery import LostStretch, RecordCount, Recovery, TopicRecovery
from symbid_ros.messages.topics import Topic

UNKNOWN_TOPIC = Topic("(unknown topic)", "")


@dataclass
class Account:
    """Counts of messages by topic and of other records by opcode.

    Attributes
    ----------
    kept, told : Counter of Topic
        Messages that were kept, and that the bag states to hold.
    unassigned : int
        Messages that were lost, whose topics are unknown.
    holes : list of LostStretch
    records, records_lost : Counter of int
    repeated : int
        Chunks found twice.
    is_counted : bool
        Whether every lost message is counted.
    """

    kept: Counter[Topic] = field(default_factory=Counter)
    told: Counter[Topic] = field(default_factory=Counter)
    unassigned: int = 0
    holes: list[LostStretch] = field(default_factory=list)
    records: Counter[int] = field(default_factory=Counter)
    records_lost: Counter[int] = field(default_factory=Counter)
    repeated: int = 0
    is_counted: bool = True

    def recovery(self, bag: Path, out: Path) -> Recovery:
        """Return what became of a bag and where the new one is."""
        known = sum((self.told - self.kept).values())
        if self.unassigned > known:
            self.told[UNKNOWN_TOPIC] += self.unassigned - known
        topics = tuple(
            TopicRecovery(
                topic.name,
                topic.msgtype,
                self.kept[topic],
                max(0, self.told[topic] - self.kept[topic]),
            )
            for topic in sorted({*self.told, *self.kept}, key=lambda topic: topic.name)
        )
        attachments, metadata = (
            RecordCount(self.records[opcode], self.records_lost[opcode])
            for opcode in (Opcode.ATTACHMENT, Opcode.METADATA)
        )
        return Recovery(
            bag,
            out,
            topics,
            tuple(self.holes),
            attachments,
            metadata,
            self.repeated,
            self.is_counted,
        )
