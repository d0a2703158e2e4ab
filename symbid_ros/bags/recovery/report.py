"""Report of a recovery: what was kept and what was lost."""

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from symbid_ros.json_documents import versioned, with_keys
from symbid_ros.messages.topics import Topic

# Fields of a lost range and their keys in JSON, with units.
_KEYS = {
    "offset": "offset_bytes",
    "length": "length_bytes",
    "after": "after_ns",
    "before": "before_ns",
}


@dataclass(frozen=True)
class LostRange:
    """A lost part of a recording."""

    file: str  # name of the damaged file
    offset: int  # of the unusable bytes; 0 for a missing file
    length: int  # number of unusable bytes; 0 for a missing file
    fault: str  # why they are unusable
    after: int | None = None  # log time of the last message kept before it, ns; None at the start
    before: int | None = None  # log time of the first message kept after it, ns; None at the end
    messages: int = 0  # lower bound of the lost messages
    is_counted: bool = False  # whether this is their exact number


@dataclass(frozen=True)
class TopicRecovery:
    """Messages of a topic that were kept, and those known to be lost."""

    name: str
    msgtype: str
    kept: int
    lost: int


@dataclass(frozen=True)
class RecordCount:
    """Attachment or metadata records that were kept, and those that were lost."""

    kept: int
    lost: int


@dataclass(frozen=True)
class RecoveryReport:
    """The result of a recovery."""

    source: Path  # the damaged bag, which is not changed
    out: Path  # the new bag
    topics: tuple[TopicRecovery, ...]
    holes: tuple[LostRange, ...]
    attachments: RecordCount
    metadata: RecordCount  # without rosbag2's own metadata record, which is rewritten
    repeated: int  # chunks that were in the bag twice
    is_counted: bool  # whether all lost messages are counted; False if a range may have held more

    @property
    def kept(self) -> int:
        """Messages kept."""
        return sum(topic.kept for topic in self.topics)

    @property
    def lost(self) -> int:
        """Messages known to be lost."""
        return sum(topic.lost for topic in self.topics)

    @property
    def is_whole(self) -> bool:
        """Whether nothing was lost."""
        records_lost = self.attachments.lost + self.metadata.lost
        return self.is_counted and not self.lost and not records_lost

    def as_dict(self) -> dict[str, Any]:
        """Return the output of ``symbid bag recover --json``."""
        totals = {"kept": self.kept, "lost": self.lost, "is_whole": self.is_whole}
        holes = [with_keys(asdict(hole), _KEYS) for hole in self.holes]
        paths = {"source": str(self.source), "out": str(self.out)}
        return versioned("bag_recovery", {**asdict(self), **paths, "holes": holes, **totals})


UNKNOWN_TOPIC = Topic("(unknown topic)", "")


@dataclass
class RecoveryCounts:
    """Running counts of messages by topic and of other records by opcode, and lost ranges."""

    kept: Counter[Topic] = field(default_factory=Counter)
    stated: Counter[Topic] = field(default_factory=Counter)  # messages that the bag should hold
    unassigned: int = 0  # lost messages of unknown topics
    holes: list[LostRange] = field(default_factory=list)
    records: Counter[int] = field(default_factory=Counter)
    records_lost: Counter[int] = field(default_factory=Counter)
    repeated: int = 0  # chunks found twice
    is_counted: bool = True  # whether all lost messages are counted
    _latest: int | None = None  # log time of the last message kept of the current file
    _followed: int = 0  # number of lost ranges before that message

    def begin_file(self) -> None:
        """Begin with the next file."""
        self._latest, self._followed = None, len(self.holes)

    def add_hole(self, hole: LostRange) -> None:
        """Add a lost range that follows the messages kept so far of the current file."""
        self.holes.append(replace(hole, after=self._latest))

    def add_kept_times(self, first: int, last: int) -> None:
        """Note the first and last log time, ns, of the next messages kept of the current file."""
        for place in range(self._followed, len(self.holes)):
            self.holes[place] = replace(self.holes[place], before=first)
        self._latest, self._followed = last, len(self.holes)

    def report(self, bag: Path, out: Path) -> RecoveryReport:
        """Return the report on a bag that was recovered into ``out``."""
        known = sum((self.stated - self.kept).values())
        if self.unassigned > known:
            self.stated[UNKNOWN_TOPIC] += self.unassigned - known
        topics = tuple(
            TopicRecovery(
                topic.name,
                topic.msgtype,
                self.kept[topic],
                max(0, self.stated[topic] - self.kept[topic]),
            )
            for topic in sorted({*self.stated, *self.kept}, key=lambda topic: topic.name)
        )
        attachments, metadata = (
            RecordCount(self.records[opcode], self.records_lost[opcode])
            for opcode in (Opcode.ATTACHMENT, Opcode.METADATA)
        )
        return RecoveryReport(
            bag,
            out,
            topics,
            tuple(self.holes),
            attachments,
            metadata,
            self.repeated,
            self.is_counted,
        )
