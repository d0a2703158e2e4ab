"""Report of a recovery: what was kept and what was lost."""

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from symbid_ros.messages.topics import Topic


@dataclass(frozen=True)
class LostRange:
    """A lost part of a recording.

    Attributes
    ----------
    file : str
        Name of the damaged file.
    offset, length : int
        Unusable bytes of the file; both 0 for a missing file.
    fault : str
        Why they are unusable.
    after, before : int or None
        Log times of the messages kept before and after it, nanoseconds; None at either end.
    messages : int
        Lower bound of the lost messages.
    is_counted : bool
        Whether this is their exact number.
    """

    file: str
    offset: int
    length: int
    fault: str
    after: int | None = None
    before: int | None = None
    messages: int = 0
    is_counted: bool = False


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
    """The result of a recovery.

    Attributes
    ----------
    source, out : Path
        The damaged bag, which is not changed, and the new one.
    topics : tuple of TopicRecovery
    holes : tuple of LostRange
    attachments, metadata : RecordCount
        rosbag2's own metadata record, which is rewritten, does not count.
    repeated : int
        Chunks that were in the bag twice.
    is_counted : bool
        Whether all lost messages are counted; False if some range may have held more.
    """

    source: Path
    out: Path
    topics: tuple[TopicRecovery, ...]
    holes: tuple[LostRange, ...]
    attachments: RecordCount
    metadata: RecordCount
    repeated: int
    is_counted: bool

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
        return {**asdict(self), "source": str(self.source), "out": str(self.out), **totals}


UNKNOWN_TOPIC = Topic("(unknown topic)", "")


@dataclass
class RecoveryCounts:
    """Running counts of messages by topic and of other records by opcode, and lost ranges.

    Attributes
    ----------
    kept, stated : Counter of Topic
        Messages that were kept, and that the bag should hold.
    unassigned : int
        Lost messages of unknown topics.
    holes : list of LostRange
    records, records_lost : Counter of int
    repeated : int
        Chunks found twice.
    is_counted : bool
        Whether all lost messages are counted.
    """

    kept: Counter[Topic] = field(default_factory=Counter)
    stated: Counter[Topic] = field(default_factory=Counter)
    unassigned: int = 0
    holes: list[LostRange] = field(default_factory=list)
    records: Counter[int] = field(default_factory=Counter)
    records_lost: Counter[int] = field(default_factory=Counter)
    repeated: int = 0
    is_counted: bool = True
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
