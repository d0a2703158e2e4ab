"""Live topics as one recording of which the newest seconds are at hand."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.sensor_streams import build_streams
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.signals.defects import DefectCounts
from symbid_ros.signals.stamps import CLOCK_JUMP, find_gaps, seconds
from symbid_ros.signals.streams import Streams

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


@dataclass
class LiveStreams:
    """Messages of a robot's sensor topics on one clock, their stamps'.

    Where a clock jumps back, by more than messages overtake each other, a new time begins: what
    other topics still send of the old one is left out.

    Attributes
    ----------
    selected : SelectedTopics
        Which they are.
    source : str
        How messages to the user name them.
    worked_until : int or None
        End of the last block given out, ns: what comes before it is late.
    buffers : dict of Topic to TopicBuffer
        What waits.
    """

    selected: SelectedTopics
    source: str
    worked_until: int | None = None
    buffers: dict[Topic, TopicBuffer] = field(init=False)
    _clock: int | None = None

    def __post_init__(self) -> None:
        self.buffers = {topic: TopicBuffer(topic) for topic in self.selected.all}

    @property
    def joints(self) -> TopicBuffer:
        """The joint states, whose stamps are the clock."""
        return self.buffers[self.selected.clock]

    def jumps_back(self, topic: Topic, stamp: int) -> bool:
        """Tell whether a message of that stamp, ns, begins a new time."""
        newest = self.buffers[topic].newest
        return stamp > 0 and newest is not None and stamp < newest - CLOCK_JUMP

    def restart(self) -> None:
        """Begin a new time, for which nothing is at hand yet."""
        self.worked_until = self._clock = None
        for buffer in self.buffers.values():
            buffer.clear()

    def add(self, topic: Topic, stamp: int, payload: bytes) -> None:
        """Take a message and its stamp, ns."""
        buffer = self.buffers[topic]
        buffer.received += 1
        # A simulation may begin at zero; a second zero shows that the driver sets no stamps.
        if stamp <= 0 and (buffer.newest is not None or buffer.unstamped):
            buffer.unstamped += 1
            if buffer.newest == 0:
                self._forget(buffer)
            return
        # The first of this topic: of this time, or left over from the one before?
        is_first = self._clock is not None and buffer.newest is None
        if is_first and abs(stamp - (self._clock or 0)) > CLOCK_JUMP:
            buffer.stale += 1
            buffer.newest_stale = stamp
            return
        if self.worked_until is not None and stamp < self.worked_until:
            buffer.late += 1
            return
        buffer.add(stamp, payload)
        self._clock = stamp if self._clock is None else max(self._clock, stamp)

    def _forget(self, buffer: TopicBuffer) -> None:
        """Drop what a topic has sent, and take the clock from the others."""
        buffer.clear()
        newest = [one.newest for one in self.buffers.values() if one.newest is not None]
        self._clock = max(newest, default=None)

    @property
    def clock(self) -> int | None:
        """Newest stamp of any topic, ns."""
        return self._clock

    @property
    def stale(self) -> int:
        """Messages left out because they belonged to no time that is worth waiting for."""
        return sum(buffer.stale for buffer in self.buffers.values())

    @property
    def complete_until(self) -> int | None:
        """Newest stamp (ns) that every topic has reached; None while one is silent."""
        newest = [buffer.newest for buffer in self.buffers.values()]
        known = [stamp for stamp in newest if stamp is not None]
        return min(known) if len(known) == len(newest) else None

    def between(self, start: int, stop: int) -> Streams:
        """Return the streams from ``start`` up to ``stop``, ns.

        Raises
        ------
        DataError
            When a topic has no message there, or an unusable one.
        """
        decoders = {}
        for topic, buffer in self.buffers.items():
            decoders[topic] = buffer.decoder(self.source, start, stop)
            if not decoders[topic].count:
                raise DataError(
                    f"{self.source}: {topic.name} was silent from {seconds(start)} to "
                    f"{seconds(stop)}; check its driver",
                    "E313",
                )
        tallies = {topic: DefectCounts(self.source, topic.name) for topic in decoders}
        streams = build_streams(self.source, self.selected, decoders, tallies)
        streams = replace(streams, is_live=True)
        for topic, tally in tallies.items():
            tally.messages = decoders[topic].count
            tally.report()
        return streams

    def forget_before(self, stamp: int) -> None:
        """Let go of what is older than ``stamp``, ns."""
        for buffer in self.buffers.values():
            buffer.drop_before(stamp)
