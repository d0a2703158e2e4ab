"""Decoded messages of one topic that wait until every topic has reached their time."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, IntArray
from symbid_ros.bags.container.blocks import Topic
from symbid_ros.bags.layout import ByteArray
from symbid_ros.bags.messages import read_stamp
from symbid_ros.bags.streams.decoder import Piece, TopicDecoder
from symbid_ros.bags.streams.stamps import check_clock
from symbid_ros.bags.streams.tally import ALWAYS, Defect, Tally


@dataclass
class Backlog:
    """The messages of one topic, from the oldest that is still wanted.

    Attributes
    ----------
    decoder : TopicDecoder
        Decodes them; what it has decoded is taken from it at once.
    tally : Tally
        What is wrong with them.
    newest : int or None
        Largest stamp so far, ns; None before the first message.
    size : int
        Bytes that wait.
    """

    decoder: TopicDecoder
    tally: Tally
    newest: int | None = None
    size: int = 0
    _last: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _parts: list[tuple[Piece, IntArray]] = field(default_factory=list)

    @classmethod
    def of(cls, source: str, topic: Topic) -> "Backlog":
        """Return that of a topic before its first message."""
        return cls(TopicDecoder(source, topic), Tally(source, topic.name))

    def add(self, data: ByteArray, spans: IntArray, worked_until: int = ALWAYS[0]) -> None:
        """Take the payloads (N, 2: start, length) of one block of bytes.

        Those stamped before ``worked_until``, ns, are counted and left out.

        Raises
        ------
        DataError
            When one cannot be decoded, or their clock jumps back.
        """
        if not len(spans):
            return
        first = self.decoder.count
        self.decoder.add(data, spans)
        recorded = np.empty(len(spans), dtype=np.int64)
        for piece in self.decoder.pieces:
            stamps = read_stamp(piece.records)
            recorded[piece.index - first] = stamps
            numbers = Piece(piece.layout, piece.index, piece.layout.condensed(piece.records))
            self._keep(numbers, stamps, stamps >= worked_until)
        self.decoder.pieces = []
        topic = self.decoder.topic.name
        check_clock(self.decoder.source, topic, np.append(self._last, recorded))
        self._last = recorded[-1:]
        self.tally.during = ALWAYS
        self.tally.see(recorded)
        self.tally.add(Defect.LATE, recorded, recorded < worked_until)
        newest = int(recorded.max())
        self.newest = newest if self.newest is None else max(self.newest, newest)

    def between(self, start: int, stop: int) -> TopicDecoder:
        """Return the messages with stamps from ``start`` up to ``stop``, ns."""
        pieces = []
        for piece, stamps in self._parts:
            inside = (stamps >= start) & (stamps < stop)
            if inside.all():
                pieces.append(piece)
            elif inside.any():
                pieces.append(_some(piece, inside))
        places = np.sort(np.concatenate([np.empty(0, np.int64), *(p.index for p in pieces)]))
        decoder = self.decoder
        return TopicDecoder(
            decoder.source,
            decoder.topic,
            [Piece(p.layout, np.searchsorted(places, p.index), p.records) for p in pieces],
            len(places),
        )

    def first_from(self, start: int) -> int | None:
        """Return the oldest stamp that waits from ``start`` on, ns."""
        waiting = [stamps[stamps >= start] for _, stamps in self._parts]
        return min((int(stamps.min()) for stamps in waiting if len(stamps)), default=None)

    def drop_before(self, stamp: int) -> None:
        """Let go of what is older than ``stamp``, ns."""
        parts, self._parts, self.size = self._parts, [], 0
        for piece, stamps in parts:
            self._keep(piece, stamps, stamps >= stamp)

    def _keep(self, piece: Piece, stamps: IntArray, wanted: BoolArray) -> None:
        if not wanted.any():
            return
        if not wanted.all():
            piece, stamps = _some(piece, wanted), stamps[wanted]
        self._parts.append((piece, stamps))
        self.size += piece.records.nbytes


def _some(piece: Piece, wanted: BoolArray) -> Piece:
    return Piece(piece.layout, piece.index[wanted], piece.records[wanted])
