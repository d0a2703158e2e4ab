"""Buffer for decoded messages of one topic until all topics have reached their time."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.messages.decoder import DecodedBatch, TopicDecoder
from symbid_ros.messages.layout import ByteArray
from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import read_stamp
from symbid_ros.signals.defects import ALWAYS, Defect, DefectCounts, check_clock


@dataclass
class ReorderBuffer:
    """The buffered messages of one topic.

    Attributes
    ----------
    decoder : TopicDecoder
        Decodes the messages, which are then moved from it to the buffer.
    tally : DefectCounts
        Defects of the messages.
    newest : int or None
        Largest stamp so far, ns; None before the first message.
    size : int
        Buffered bytes.
    """

    decoder: TopicDecoder
    tally: DefectCounts
    newest: int | None = None
    size: int = 0
    _last: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _parts: list["_Part"] = field(default_factory=list)

    @classmethod
    def of(cls, source: str, topic: Topic) -> "ReorderBuffer":
        """Return an empty buffer for a topic."""
        return cls(TopicDecoder(source, topic), DefectCounts(source, topic.name))

    def add(
        self,
        data: ByteArray,
        spans: IntArray,
        processed_until: int = ALWAYS[0],
        requested_from: int = ALWAYS[0],
    ) -> None:
        """Decode and add the payloads (N, 2: start, length) in a block of bytes.

        Messages with stamps before ``processed_until``, ns, are dropped. They count as late if they
        belong to the requested part, which starts at ``requested_from``.

        Raises
        ------
        DataError
            When a message cannot be decoded, or the clock jumps back.
        """
        if not len(spans):
            return
        first = self.decoder.count
        self.decoder.add(data, spans)
        recorded = np.empty(len(spans), dtype=np.int64)
        for batch in self.decoder.batches:
            stamps = read_stamp(batch.records)
            recorded[batch.index - first] = stamps
            numbers = DecodedBatch(batch.layout, batch.index, batch.layout.packed(batch.records))
            self._keep(_Part(numbers, stamps).between(processed_until, ALWAYS[1]))
        self.decoder.batches = []
        topic = self.decoder.topic.name
        check_clock(self.decoder.source, topic, np.append(self._last, recorded))
        self._last = recorded[-1:]
        self.tally.during = ALWAYS
        self.tally.see(recorded)
        is_late = (recorded >= requested_from) & (recorded < processed_until)
        self.tally.add(Defect.LATE, recorded, is_late)
        newest = int(recorded.max())
        self.newest = newest if self.newest is None else max(self.newest, newest)

    def between(self, start: int, stop: int) -> TopicDecoder:
        """Return the messages with stamps from ``start`` up to ``stop``, ns."""
        batches = [inside.batch for part in self._parts if (inside := part.between(start, stop))]
        index = np.concatenate([np.empty(0, np.int64), *(batch.index for batch in batches)])
        places = np.empty_like(index)
        places[np.argsort(index, kind="stable")] = np.arange(len(index))
        ends = np.cumsum([len(batch.index) for batch in batches])
        decoder = self.decoder
        return TopicDecoder(
            decoder.source,
            decoder.topic,
            [
                DecodedBatch(batch.layout, its, batch.records)
                for batch, its in zip(batches, np.split(places, ends), strict=False)
            ],
            len(index),
        )

    @property
    def stamps(self) -> IntArray:
        """(N,) stamps of the buffered messages, ns, in order of recording."""
        return np.concatenate([np.empty(0, np.int64), *(part.stamps for part in self._parts)])

    def first_from(self, start: int) -> int | None:
        """Return the smallest buffered stamp from ``start`` on, ns."""
        waiting = (part.between(start, ALWAYS[1]) for part in self._parts)
        return min((part.oldest for part in waiting if part), default=None)

    def drop_before(self, stamp: int) -> None:
        """Drop messages older than ``stamp``, ns."""
        parts, self._parts, self.size = self._parts, [], 0
        for part in parts:
            self._keep(part.between(stamp, ALWAYS[1]))

    def _keep(self, part: "_Part | None") -> None:
        if part:
            self._parts.append(part)
            self.size += part.batch.records.nbytes


@dataclass(frozen=True)
class _Part:
    """Messages of one layout and one block, at least one."""

    batch: DecodedBatch
    stamps: IntArray

    @cached_property
    def oldest(self) -> int:
        return int(self.stamps.min())

    @cached_property
    def newest(self) -> int:
        return int(self.stamps.max())

    def between(self, start: int, stop: int) -> "_Part | None":
        """Return the messages with stamps from ``start`` up to ``stop``, ns; None if none."""
        if start <= self.oldest and self.newest < stop:
            return self
        wanted = (self.stamps >= start) & (self.stamps < stop)
        if not wanted.any():
            return None
        batch = self.batch
        some = DecodedBatch(batch.layout, batch.index[wanted], batch.records[wanted])
        return _Part(some, self.stamps[wanted])
