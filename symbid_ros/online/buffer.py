"""Serialised messages of one topic that wait to be decoded, with their stamps."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.topics import Topic
from symbid_ros.signals.gaps import find_gaps

# Nobody works on data this much older than the topic's newest, ns, nor looks for it more often than
# every so many messages.
LONGEST_WAIT = 30_000_000_000
TIDY = 4096


@dataclass
class TopicBuffer:
    """Messages in order of arrival.

    Attributes
    ----------
    topic : Topic
    received : int
        All messages that ever came.
    late : int
        Of these, those whose time had already been worked on.
    unstamped : int
        Of these, those left out because their stamp was zero.
    stale : int
        Of these, those left out because the other topics' clock was at another time.
    newest_stale : int
        Stamp of the newest of these, ns.
    newest : int or None
        Largest stamp that waits or has been worked on, ns; None before the first.
    missing : int
        Messages that would fill the gaps between stamps, as far as `count_gaps` has gone.
    disordered : int
        Messages that were not later than the one before, likewise.
    """

    topic: Topic
    received: int = 0
    late: int = 0
    unstamped: int = 0
    stale: int = 0
    newest_stale: int = 0
    newest: int | None = None
    missing: int = 0
    disordered: int = 0
    _counted: int | None = None
    _stamps: "array[int]" = field(default_factory=lambda: array("q"))
    _payloads: list[bytes] = field(default_factory=list)
    _layouts: list[Layout] = field(default_factory=list)

    def add(self, stamp: int, payload: bytes) -> None:
        """Append one message; its stamp is in nanoseconds."""
        self._stamps.append(stamp)
        self._payloads.append(payload)
        if self.newest is None or stamp > self.newest:
            self.newest = stamp
        if len(self._payloads) % TIDY == 0:
            self.drop_before(self.newest - LONGEST_WAIT)

    @property
    def stamps(self) -> IntArray:
        """(N,) stamps of what waits, in order of arrival."""
        return np.array(self._stamps, dtype=np.int64)

    def decoder(self, source: str, start: int, stop: int) -> TopicDecoder:
        """Return the messages with stamps from ``start`` up to ``stop``, decoded."""
        stamps = self.stamps
        places = np.flatnonzero((stamps >= start) & (stamps < stop))
        payloads = [self._payloads[place] for place in places]
        lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
        starts = np.cumsum(lengths) - lengths
        decoder = TopicDecoder(source, self.topic, layouts=self._layouts)
        data = np.frombuffer(b"".join(payloads), dtype=np.uint8)
        decoder.add(data, np.stack([starts, lengths], axis=1))
        return decoder

    def count_gaps(self, stop: int) -> None:
        """Count what is missing between the last stamp so counted and ``stop``, ns."""
        stamps = self.stamps
        begun = stamps[stamps < stop]
        if self._has_parts:
            begun = np.unique(begun)  # several messages of one stamp are parts of one
        if self._counted is not None:
            begun = begun[begun >= self._counted]
        if len(begun):
            gaps = find_gaps(begun)
            self.missing += gaps.missing
            self.disordered += gaps.disordered
            self._counted = int(begun.max())

    @property
    def _has_parts(self) -> bool:
        """Whether messages name different joints."""
        return len({layout.text.get("name") for layout in self._layouts}) > 1

    def drop_before(self, stamp: int) -> None:
        """Let go of messages older than ``stamp``."""
        self._keep(np.flatnonzero(self.stamps >= stamp))

    def clear(self) -> None:
        """Let go of all messages and begin another time."""
        self._keep(())
        self.newest = self._counted = None

    def _keep(self, places: Iterable[int]) -> None:
        kept = list(places)
        if len(kept) < len(self._payloads):
            self._stamps = array("q", [self._stamps[place] for place in kept])
            self._payloads = [self._payloads[place] for place in kept]
