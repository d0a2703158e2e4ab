"""Read bags as streams of arrays in slices of time, so that long logs need not fit in memory."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.bags.clock_jumps import ClockJumps, earliest_before_jump
from symbid_ros.bags.container.blocks import MessageBlock
from symbid_ros.bags.container.files import count_messages, join_names, read_blocks
from symbid_ros.bags.recordings import separate_recordings
from symbid_ros.errors import DataError
from symbid_ros.messages.contact_flags import FlagHistory
from symbid_ros.messages.decoder import MAX_LAYOUTS, DecodedBatch, TopicDecoder
from symbid_ros.messages.layout import ByteArray
from symbid_ros.messages.name_check import RecordedNames, check_names
from symbid_ros.messages.sensor_streams import build_streams, read_split_stamps, read_stamps
from symbid_ros.messages.static_transforms import is_static, static_transforms
from symbid_ros.messages.topics import (
    SelectedTopics,
    Topic,
    TopicSelection,
    TopicSelector,
    describe_topics,
)
from symbid_ros.messages.types import read_leading_stamp, read_stamp
from symbid_ros.progress import report
from symbid_ros.signals.alignment import LONGEST_MARGIN, resampling_margin
from symbid_ros.signals.defects import (
    ALWAYS,
    CLOCK_JUMP,
    Defect,
    DefectCounts,
    check_clock,
    seconds,
)
from symbid_ros.signals.segments import SECOND, WALL_CLOCK, shift_behind
from symbid_ros.signals.streams import WHOLE_LOG, Slice, TimeRange

# Bytes to buffer for a topic that lags, because it is silent or recorded with a delay.
MAX_BUFFERED = 256 << 20
# To save memory, slices of logs with a higher rate of joint states than HIGH_RATE, Hz, last at most
# SHORT_SPAN, ns. At low rates, blocks of rows last up to 20 s, and a slice must hold whole blocks.
SHORT_SPAN, HIGH_RATE = 12_000_000_000, 200.0

DEFAULT_SELECTION = TopicSelection()

logger = logging.getLogger("symbid_ros.bags")


def iterate_slices(
    bags: Sequence[Path],
    topics: TopicSelection = DEFAULT_SELECTION,
    *,
    span: int | None = None,
    part: TimeRange = WHOLE_LOG,
    warn: bool = True,
) -> Iterator[Slice]:
    """Yield the sensor topics of one or more recordings of a robot, one after the other.

    Recordings with a clock that starts at zero may have the same stamps. The later ones then move
    by whole minutes.

    Parameters
    ----------
    bags : sequence of Path
        Bag folders or files in any order; a recording may be split into several.
    topics : TopicSelection
        Topics to read.
    span : int, optional
        Length of the slices, ns; they end at its multiples, or at those of ``SHORT_SPAN`` if the
        rate is high. Default: a single slice of bags that continue one another.
    part : TimeRange
        Part of the recording.
    warn : bool
        Whether to warn at the end of defects that were repaired.

    Raises
    ------
    BagError, DataError
        When a bag or its messages are unusable.
    """
    source = join_names(bags)
    counts = count_messages(bags)
    chosen = TopicSelector(source, topics, counts).select()
    slicer = _Slicer(source, chosen, span, part)
    if len(bags) > 1:
        _warn_of_unused(tuple(bags), frozenset(chosen.all))
    total, done = sum(counts.values()), 0
    for recording in separate_recordings(bags) if span else [tuple(bags)]:
        slicer.begin(join_names(recording))
        for block in read_blocks(recording):
            report(f"reading {source}", done / total)
            done += sum(map(len, block.spans.values()))
            slicer.add(block)
            yield from slicer.complete_slices()
            if slicer.is_done:
                break
        else:
            yield from slicer.remaining_slices()
        if slicer.is_done:
            break
    slicer.check_names(topics)
    chosen.unwrapper.report(source, chosen.clock.name)
    if warn:
        slicer.report()


@cache
def _warn_of_unused(bags: tuple[Path, ...], used: frozenset[Topic]) -> None:
    """Warn about bags that add nothing to a log, once."""
    for bag in bags:
        inside = count_messages([bag])
        if not any(topic in used or is_static(topic) for topic in inside):
            logger.warning("%s: none of its topics is used, %s", bag, describe_topics(inside))


class _Slicer:
    """Buffers the messages of all topics and cuts them into slices."""

    def __init__(
        self, source: str, chosen: SelectedTopics, span: int | None, part: TimeRange
    ) -> None:
        self._source, self._chosen, self._span, self._part = source, chosen, span, part
        self._buffers = {
            topic: ReorderBuffer(TopicDecoder(source, topic), DefectCounts(source, topic.name))
            for topic in chosen.all
        }
        self._joints = self._buffers[chosen.clock]
        self._jumps = ClockJumps(source, chosen.clock.name, part)
        self._flags = tuple(FlagHistory(one, chosen.flagged_frame(one)) for one in chosen.flags)
        self._last_joint_state: int | None = None
        self._processed_until, self._end = ALWAYS
        self._requested_from = self._processed_until
        self._has_begun = False
        self._recording = -1
        self._name = ""
        self._shift: int | None = 0
        self._static_frames: set[str] = set()

    def begin(self, name: str) -> None:
        """Begin with a further recording; ``name`` is that of its bags, for messages."""
        self._recording += 1
        self._name = name
        if self._recording == 0:
            return
        self._last_joint_state, self._shift = None, None
        newest = [one.newest for one in self._buffers.values() if one.newest is not None]
        if newest:
            # The last slice ended later, at a multiple of its length.
            self._processed_until = max(max(newest) + 1, self._requested_from)
        for buffer in self._buffers.values():
            buffer.begin()
        self._jumps.begin()

    @property
    def is_done(self) -> bool:
        """Whether the requested part has been read."""
        return self._processed_until >= self._end

    def add(self, block: MessageBlock) -> None:
        """Add the messages of a block."""
        if self._shift is None:
            self._shift = self._shift_of(block)
        if self._jumps.first is None and self._chosen.clock in block.spans:
            spans = block.spans[self._chosen.clock].tolist()
            stamps = [read_leading_stamp(block.data[at : at + n].tobytes()) for at, n in spans]
            self._jumps.first = earliest_before_jump(np.array(stamps)) if stamps else None
        joints = np.empty(0, dtype=np.int64)
        for topic, buffer in self._buffers.items():
            if topic in block.spans:
                spans = block.spans[topic]
                limits = self._processed_until, self._requested_from
                added = buffer.add(block.data, spans, *limits, self._shift or 0, jumps=self._jumps)
                joints = added if topic == self._chosen.clock else joints
        if self._flags:
            self._add_flags(block, joints)
        for topic, spans in block.spans.items():
            if is_static(topic):
                for start, size in spans.tolist():
                    payload = block.data[start : start + size].tobytes()
                    for one in static_transforms(payload):
                        self._static_frames |= {one.parent, one.child}
        if not self._has_begun and (first := self._joints.first_from(ALWAYS[0])) is not None:
            self._has_begun = True
            if self._part.start > 0:
                self._processed_until = self._requested_from = first + round(1e9 * self._part.start)
            if np.isfinite(self._part.stop):
                self._end = first + round(1e9 * self._part.stop)

    def _shift_of(self, block: MessageBlock) -> int | None:
        """Return how far the stamps of a recording move, ns, given its first block.

        None if the block has no message of a sensor.
        """
        heads = [
            read_leading_stamp(block.data[start : start + size].tobytes())
            for topic in self._buffers
            for start, size in block.spans.get(topic, ())[:1]
        ]
        if not heads:
            return None
        back = self._processed_until - min(heads)
        if back <= 0 or self._processed_until == ALWAYS[0]:
            return 0
        if min(heads) >= WALL_CLOCK:
            raise DataError(
                f"{self._name}: its stamps begin {back * 1e-9:.3f} s before another bag ends; "
                "leave copies out, or identify one, and give its `information` with the other",
                "E530",
            )
        return shift_behind(min(heads), self._processed_until)

    def _add_flags(self, block: MessageBlock, joints: IntArray) -> None:
        """Add the flags of a block, each with the stamp of the last joint state before it.

        ``joints`` (N,) are the stamps of the block's joint states, ns.
        """
        spans = block.spans.get(self._chosen.clock, np.zeros((0, 2), dtype=np.int64))
        stamps = joints.tolist()
        for history in self._flags:
            for start, size in block.spans.get(history.topic, ()):
                before = int(np.searchsorted(spans[:, 0], start))
                stamp = stamps[before - 1] if before else self._last_joint_state
                if stamp is not None:
                    history.add(stamp, block.data[start : start + size].tobytes())
        if stamps:
            self._last_joint_state = stamps[-1]

    def complete_slices(self) -> Iterator[Slice]:
        """Yield the slices that all topics have passed."""
        while self._span is not None and (stop := self._stop()) is not None:
            newest = min(buffer.newest or ALWAYS[0] for buffer in self._buffers.values())
            waiting = sum(buffer.size for buffer in self._buffers.values())
            if newest < stop + LONGEST_MARGIN + CLOCK_JUMP and waiting < MAX_BUFFERED:
                return
            yield self._slice(stop)

    def remaining_slices(self) -> Iterator[Slice]:
        """Yield the last slices at the end of the bags."""
        while (stop := self._stop()) is not None:
            yield self._slice(stop)

    def check_names(self, selection: TopicSelection) -> None:
        """Refuse options with names that neither the messages so far nor the model have."""
        layouts = {topic: one.decoder.layouts for topic, one in self._buffers.items()}
        if any(len(each) == MAX_LAYOUTS for each in layouts.values()):
            return  # further names may have been read

        def names(topics: Sequence[Topic], field: str) -> set[str]:
            texts = (layout.text[field] for topic in topics for layout in layouts[topic])
            return {name for text in texts for name in text}

        chosen = self._chosen
        sensors = (*chosen.imus, *chosen.wrenches, *chosen.poses)
        recorded = RecordedNames(
            self._source,
            names(chosen.joints, "name"),
            names(sensors, "header.frame_id") | self._static_frames,
            {topic.name for topic in chosen.wrenches},
        )
        held = chosen.held_joints.held
        check_names(chosen.mapping, selection.model, recorded, held, chosen.logged)

    def report(self) -> None:
        """Warn of repaired defects."""
        for buffer in self._buffers.values():
            buffer.tally.report()

    def _stop(self) -> int | None:
        """Return the end of the slice of the next joint state, ns."""
        first = None if self.is_done else self._joints.first_from(self._processed_until)
        if first is None or first >= self._end:
            return None
        if self._span is None:
            return self._end
        short = min(self._span, SHORT_SPAN)
        stop = (first // short + 1) * short
        if self._joints.count_between(first, stop) * 1e9 < HIGH_RATE * (stop - first):
            stop = (first // self._span + 1) * self._span
        return min(stop, self._end)

    def _slice(self, stop: int) -> Slice:
        self._jumps.check()
        start, self._processed_until = self._processed_until, stop
        margin = resampling_margin(buffer.stamps for buffer in self._buffers.values())
        if self._chosen.poses:
            margin = LONGEST_MARGIN  # in which their low-pass settles
        decoders, tallies = {}, {}
        for topic, buffer in self._buffers.items():
            decoders[topic] = buffer.between(start - margin, stop + margin)
            buffer.drop_before(stop - LONGEST_MARGIN)
            tallies[topic] = buffer.tally
            buffer.tally.during = (start, stop)
            if count := buffer.decoder.decoded_singly:
                buffer.tally.counts[Defect.OTHER_LAYOUT] = count
        recorded: dict[str, IntArray] = {}
        split: dict[str, tuple[IntArray, ...]] = {}
        for topic, decoder in decoders.items():
            read: tuple[IntArray, ...] = (read_stamps(decoder),)
            if topic in self._chosen.joints and decoder.count:
                read = read_split_stamps(decoder, self._chosen.recorded_joints)
            parts = tuple(each[(each >= start) & (each < stop)] for each in read)
            recorded[topic.name] = parts[0]
            if len(parts) > 1:
                recorded[topic.name] = np.unique(np.concatenate(parts))
                split[topic.name] = parts
        streams, fault = None, ""
        if silent := [topic.name for topic, decoder in decoders.items() if not decoder.count]:
            fault = (
                f"{self._source}: {', '.join(silent)} was silent up to {seconds(stop)}, or is "
                "stamped by another clock; record it again or leave it out"
            )
        else:
            try:
                streams = build_streams(self._source, self._chosen, decoders, tallies)
                streams = replace(streams, flags=tuple(one.flags for one in self._flags))
            except DataError as error:
                if error.code != "E327":
                    raise
                fault = str(error)
        tallied = tuple(tallies.values())
        return Slice(start, stop, streams, recorded, tallied, fault, self._recording, split)


@dataclass
class ReorderBuffer:
    """The decoded messages of one topic, until all topics have reached their time.

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

    def begin(self) -> None:
        """Begin with a further recording, in which the clock may have been set."""
        self._last, self._parts, self.size, self.newest = self._last[:0], [], 0, None

    def add(
        self,
        data: ByteArray,
        spans: IntArray,
        processed_until: int = ALWAYS[0],
        requested_from: int = ALWAYS[0],
        shift: int = 0,
        *,
        jumps: ClockJumps | None = None,
    ) -> IntArray:
        """Decode and add the payloads (N, 2: start, length) in a block of bytes.

        Messages with stamps before ``processed_until``, ns, are dropped. They count as late if they
        belong to the requested part, which starts at ``requested_from``. ``shift``, whole seconds
        in ns, is added to all stamps. Jumps back of the clock outside the requested part move the
        stamps after them, if ``jumps`` is given.

        Returns
        -------
        (N,) int64
            Stamps as buffered, ns.

        Raises
        ------
        DataError
            When a message cannot be decoded, or the clock jumps back.
        """
        if not len(spans):
            return np.empty(0, dtype=np.int64)
        first = self.decoder.count
        self.decoder.add(data, spans)
        sent = np.empty(len(spans), dtype=np.int64)
        for batch in self.decoder.batches:
            sent[batch.index - first] = read_stamp(batch.records)
        recorded, topic = sent + shift, self.decoder.topic.name
        if jumps is None:
            check_clock(self.decoder.source, topic, np.append(self._last, recorded))
        else:
            recorded = jumps.continued(topic, self._last, recorded)
        for batch in self.decoder.batches:
            places = batch.index - first
            stamps = recorded[places]
            records = batch.layout.packed(batch.records)
            records["header.stamp.sec"] += (stamps - sent[places]) // SECOND
            numbers = DecodedBatch(batch.layout, batch.index, records)
            self._keep(_Part(numbers, stamps).between(processed_until, ALWAYS[1]))
        self.decoder.batches = []
        self._last = recorded[-1:]
        self.tally.during = ALWAYS
        self.tally.count_messages(recorded)
        is_late = (recorded >= requested_from) & (recorded < processed_until)
        self.tally.add(Defect.LATE, recorded, is_late)
        newest = int(recorded.max())
        self.newest = newest if self.newest is None else max(self.newest, newest)
        return recorded

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

    def count_between(self, start: int, stop: int) -> int:
        """Return the number of buffered messages with stamps from ``start`` up to ``stop``, ns."""
        stamps = self.stamps
        return int(np.count_nonzero((stamps >= start) & (stamps < stop)))

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
