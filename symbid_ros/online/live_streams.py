"""Buffers the newest seconds of live topics."""

from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.contact_flags import FlagHistory
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.sensor_streams import (
    build_joints,
    build_streams,
    read_split_stamps,
)
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.signals.defects import ALWAYS, CLOCK_JUMP, DefectCounts, find_gaps, seconds
from symbid_ros.signals.streams import JointStream, Streams

# Messages this much older than the topic's newest, ns, are dropped; checked once every so many
# messages.
MAX_AGE = 30_000_000_000
CLEANUP_INTERVAL = 4096


@dataclass
class TopicBuffer:
    """Messages of one topic in order of arrival.

    Attributes
    ----------
    topic : Topic
    received : int
        All messages received so far.
    late : int
        Messages that arrived after their block was released.
    unstamped : int
        Messages ignored because their stamp was zero.
    stale : int
        Messages ignored because their stamp was far from the other topics' clock.
    newest_stale : int
        Stamp of the newest ignored message of this kind, ns.
    newest : int or None
        Largest stamp so far, ns; None before the first message.
    missing : int
        Messages missing in gaps of at most `CLOCK_JUMP` between stamps, as counted by `count_gaps`.
    pauses : int
        Longer gaps: the publisher was away, or its clock was set forward.
    disordered : int
        Messages whose stamp is not after the previous one, as counted by `count_gaps`.
    """

    topic: Topic
    received: int = 0
    late: int = 0
    unstamped: int = 0
    stale: int = 0
    newest_stale: int = 0
    newest: int | None = None
    missing: int = 0
    pauses: int = 0
    disordered: int = 0
    # Last counted stamp of the messages that name the same joints, by their index.
    _counted: dict[int, int] = field(default_factory=dict)
    _stamps: "array[int]" = field(default_factory=lambda: array("q"))
    _payloads: list[bytes] = field(default_factory=list)
    _layouts: list[Layout] = field(default_factory=list)

    def add(self, stamp: int, payload: bytes) -> None:
        """Append one message with its stamp, ns."""
        self._stamps.append(stamp)
        self._payloads.append(payload)
        if self.newest is None or stamp > self.newest:
            self.newest = stamp
        if len(self._payloads) % CLEANUP_INTERVAL == 0:
            self.drop_before(self.newest - MAX_AGE)

    @property
    def messages(self) -> Iterator[tuple[int, bytes]]:
        """The buffered messages in order of arrival, each with its stamp, ns."""
        return zip(self._stamps, self._payloads, strict=True)

    @property
    def stamps(self) -> IntArray:
        """(N,) stamps of the buffered messages in order of arrival, ns."""
        return np.array(self._stamps, dtype=np.int64)

    def decoder(self, source: str, start: int, stop: int) -> TopicDecoder:
        """Return the messages with stamps from ``start`` up to ``stop``, decoded."""
        stamps = self.stamps
        indices = np.flatnonzero((stamps >= start) & (stamps < stop))
        payloads = [self._payloads[index] for index in indices]
        lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
        starts = np.cumsum(lengths) - lengths
        decoder = TopicDecoder(source, self.topic, layouts=self._layouts)
        data = np.frombuffer(b"".join(payloads), dtype=np.uint8)
        decoder.add(data, np.stack([starts, lengths], axis=1))
        return decoder

    def count_gaps(self, stop: int) -> None:
        """Count missing messages from the end of the last call up to ``stop``, ns."""
        for part, stamps in enumerate(self._split_stamps(stop)):
            # The last stamp may be dropped already, and a gap begins with it.
            last = self._counted.get(part)
            counted = stamps if last is None else np.append(last, stamps[stamps > last])
            for each in np.split(counted, np.flatnonzero(np.diff(counted) > CLOCK_JUMP) + 1):
                gaps = find_gaps(each)
                self.missing += gaps.missing
                self.disordered += gaps.disordered
            if len(counted):
                self._counted[part] = int(counted.max())

    def _split_stamps(self, stop: int) -> tuple[IntArray, ...]:
        """Return the stamps before ``stop`` of the messages of each set of joints, ns."""
        if len({layout.text.get("name") for layout in self._layouts}) < 2:
            return (self.stamps[self.stamps < stop],)
        decoder = self.decoder(self.topic.name, ALWAYS[0], stop)
        return read_split_stamps(decoder, frozenset())

    def drop_before(self, stamp: int) -> None:
        """Drop messages older than ``stamp``, ns."""
        self._keep(np.flatnonzero(self.stamps >= stamp))

    def clear(self) -> None:
        """Drop all messages and restart the clock."""
        self._keep(())
        self.newest = None
        self._counted.clear()

    def clear_faults(self) -> None:
        """Set the numbers of late, missing and disordered messages and of pauses to zero."""
        self.late = self.missing = self.pauses = self.disordered = 0

    def _keep(self, indices: Iterable[int]) -> None:
        kept = list(indices)
        if len(kept) < len(self._payloads):
            self._stamps = array("q", [self._stamps[index] for index in kept])
            self._payloads = [self._payloads[index] for index in kept]


@dataclass
class LiveStreams:
    """Messages of a robot's sensor topics on the clock of their stamps.

    When a clock jumps back further than messages overtake each other, the clock restarts. Messages
    that other topics still send on the old clock are ignored.

    Attributes
    ----------
    selected : SelectedTopics
        The sensor topics.
    source : str
        Name of the topics in messages to the user.
    lag : int
        How far topics may lag behind one another, ns.
    released_until : int or None
        End of the last released block, ns; messages with earlier stamps are late.
    buffers : dict of Topic to TopicBuffer
        Buffered messages.
    """

    selected: SelectedTopics
    source: str
    lag: int = 0
    released_until: int | None = None
    buffers: dict[Topic, TopicBuffer] = field(init=False)
    _clock: int | None = None
    _pausing: set[Topic] = field(default_factory=set)
    _flags: dict[Topic, FlagHistory] = field(init=False)

    def __post_init__(self) -> None:
        self.buffers = {topic: TopicBuffer(topic) for topic in self.selected.all}
        self._flags = {
            topic: FlagHistory(topic, self.selected.flagged_frame(topic))
            for topic in self.selected.flags
        }

    @property
    def joints(self) -> TopicBuffer:
        """Buffer of the joint states, whose stamps are the clock."""
        return self.buffers[self.selected.clock]

    def jumps_back(self, topic: Topic, stamp: int) -> bool:
        """Return whether a stamp, ns, shows that the topic's clock jumped back."""
        newest = self.buffers[topic].newest
        return stamp > 0 and newest is not None and stamp < newest - CLOCK_JUMP

    def jump_ahead(self, topic: Topic, stamp: int) -> int:
        """Return by how much a stamp is ahead of the topic's last one, ns; 0 if it follows it."""
        newest = self.buffers[topic].newest
        is_expected = topic in self._pausing
        self._pausing.discard(topic)
        ahead = 0 if newest is None or is_expected else stamp - newest
        return ahead if ahead > CLOCK_JUMP else 0

    def expect_pause(self) -> None:
        """Expect messages to be missing before the next one of each topic."""
        self._pausing = set(self.buffers)

    def restart(self) -> None:
        """Drop all messages and restart the clock."""
        self.released_until = self._clock = None
        self.selected.unwrapper.restart()
        for buffer in self.buffers.values():
            buffer.clear()
        for history in self._flags.values():
            history.clear()

    def add_flag(self, topic: Topic, payload: bytes) -> None:
        """Add a message about a contact, which has no stamp of its own.

        Raises
        ------
        DataError
            When the message is invalid.
        """
        if self.joints.newest is not None:
            self._flags[topic].add(self.joints.newest, payload)

    def add(self, topic: Topic, stamp: int, payload: bytes) -> None:
        """Add a message with its stamp, ns."""
        buffer = self.buffers[topic]
        buffer.received += 1
        # A simulation may start at zero; a second zero shows that the driver sets no stamps.
        if stamp <= 0 and (buffer.newest is not None or buffer.unstamped):
            buffer.unstamped += 1
            if buffer.newest == 0:
                self._drop_topic(buffer)
            return
        # The topic's first message may still have a stamp of the old clock.
        ahead = 0 if self._clock is None else stamp - self._clock
        if buffer.newest is None and not -max(self.lag, CLOCK_JUMP) <= ahead <= CLOCK_JUMP:
            buffer.stale += 1
            buffer.newest_stale = stamp
            return
        if self.released_until is not None and stamp < self.released_until:
            buffer.late += 1
            return
        buffer.add(stamp, payload)
        self._clock = stamp if self._clock is None else max(self._clock, stamp)

    def _drop_topic(self, buffer: TopicBuffer) -> None:
        """Drop a topic's messages and take the clock from the other topics."""
        buffer.clear()
        newest = [one.newest for one in self.buffers.values() if one.newest is not None]
        self._clock = max(newest, default=None)

    @property
    def clock(self) -> int | None:
        """Newest stamp of any topic, ns."""
        return self._clock

    @property
    def stale(self) -> int:
        """Number of messages ignored because their stamp was far from the clock."""
        return sum(buffer.stale for buffer in self.buffers.values())

    @property
    def complete_until(self) -> int | None:
        """Newest stamp (ns) that every topic has reached; None while one is silent."""
        newest = [buffer.newest for buffer in self.buffers.values()]
        known = [stamp for stamp in newest if stamp is not None]
        return min(known) if len(known) == len(newest) else None

    def between(self, start: int, stop: int) -> Streams:
        """Return the decoded streams from ``start`` up to ``stop``, ns.

        Raises
        ------
        DataError
            When a topic has no message in this time, or an unusable one.
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
        defects = {topic: DefectCounts(self.source, topic.name) for topic in decoders}
        streams = build_streams(self.source, self.selected, decoders, defects)
        self.selected.unwrapper.report(self.source, self.selected.clock.name)
        flags = tuple(history.flags for history in self._flags.values())
        streams = replace(streams, is_live=True, flags=flags)
        for topic, counts in defects.items():
            counts.messages = decoders[topic].count
            counts.report()
        return streams

    def messages(self) -> Iterator[tuple[Topic, bytes]]:
        """Yield the buffered messages of all topics in the order of their stamps."""
        buffered = (
            (stamp, index, topic, payload)
            for topic, buffer in self.buffers.items()
            for index, (stamp, payload) in enumerate(buffer.messages)
        )
        for _, _, topic, payload in sorted(buffered, key=lambda one: one[:2]):
            yield topic, payload

    def newest_joints(self, duration: int) -> JointStream:
        """Return the joint states of the last ``duration`` ns, without a report of defects.

        Raises
        ------
        DataError
            When there is none.
        """
        newest = self.joints.newest
        if newest is None:
            raise DataError(f"{self.source}: no joint states yet; start their driver", "E313")
        decoders = {
            topic: self.buffers[topic].decoder(self.source, newest - duration, newest + 1)
            for topic in self.selected.joints
        }
        present = {topic: decoder for topic, decoder in decoders.items() if decoder.count}
        chosen = replace(self.selected, joints=tuple(present))
        defects = {topic: DefectCounts(self.source, topic.name) for topic in present}
        return build_joints(self.source, chosen, present, defects)

    def drop_before(self, stamp: int) -> None:
        """Drop messages older than ``stamp``, ns."""
        for buffer in self.buffers.values():
            buffer.drop_before(stamp)
        for history in self._flags.values():
            history.drop_before(stamp - MAX_AGE)
