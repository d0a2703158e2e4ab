"""Read bags as streams of arrays in slices of time, so that long logs need not fit in memory."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.bags.container.blocks import MessageBlock
from symbid_ros.bags.container.files import count_messages, join_names, read_blocks
from symbid_ros.bags.reorder_buffer import ReorderBuffer
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.sensor_streams import build_streams, group_joints, read_stamps
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection, TopicSelector
from symbid_ros.signals.alignment import LONGEST_MARGIN, resampling_margin
from symbid_ros.signals.defects import ALWAYS, CLOCK_JUMP, Defect, seconds
from symbid_ros.signals.streams import ALL_OF_IT, Slice, TimeRange

# Bytes to buffer for a topic that lags, because it is silent or recorded with a delay.
MAX_BUFFERED = 256 << 20


DEFAULT_SELECTION = TopicSelection()


def iterate_slices(
    bags: Sequence[Path],
    topics: TopicSelection = DEFAULT_SELECTION,
    *,
    span: int | None = None,
    part: TimeRange = ALL_OF_IT,
    warn: bool = True,
) -> Iterator[Slice]:
    """Yield the sensor topics of one recording.

    Parameters
    ----------
    bags : sequence of Path
        Bag folders or files that continue one another; read separate runs separately.
    topics : TopicSelection
        Topics to read.
    span : int, optional
        Length of the slices, ns; they end at its multiples. Default: a single slice.
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
    slicer = _Slicer(
        source, TopicSelector(source, topics, count_messages(bags)).select(), span, part
    )
    for block in read_blocks(bags):
        slicer.add(block)
        yield from slicer.complete_slices()
        if slicer.is_done:
            break
    else:
        yield from slicer.remaining_slices()
    if warn:
        slicer.report()


class _Slicer:
    """Buffers the messages of all topics and cuts them into slices."""

    def __init__(
        self, source: str, chosen: SelectedTopics, span: int | None, part: TimeRange
    ) -> None:
        self._source, self._chosen, self._span, self._part = source, chosen, span, part
        self._buffers = {topic: ReorderBuffer.of(source, topic) for topic in chosen.all}
        self._joints = self._buffers[chosen.clock]
        self._until, self._end = ALWAYS
        self._begin = self._until  # of the requested part
        self._has_begun = False

    @property
    def is_done(self) -> bool:
        """Whether the requested part has been read."""
        return self._until >= self._end

    def add(self, block: MessageBlock) -> None:
        """Add the messages of a block."""
        for topic, buffer in self._buffers.items():
            if topic in block.spans:
                buffer.add(block.data, block.spans[topic], self._until, self._begin)
        if not self._has_begun and (first := self._joints.first_from(ALWAYS[0])) is not None:
            self._has_begun = True
            if self._part.start > 0:
                self._until = self._begin = first + round(1e9 * self._part.start)
            if np.isfinite(self._part.stop):
                self._end = first + round(1e9 * self._part.stop)

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

    def report(self) -> None:
        """Warn of repaired defects."""
        for buffer in self._buffers.values():
            buffer.tally.report()

    def _stop(self) -> int | None:
        """Return the end of the slice of the next joint state, ns."""
        first = None if self.is_done else self._joints.first_from(self._until)
        if first is None or first >= self._end:
            return None
        if self._span is None:
            return self._end
        return min((first // self._span + 1) * self._span, self._end)

    def _slice(self, stop: int) -> Slice:
        start, self._until = self._until, stop
        for buffer in self._buffers.values():
            buffer.tally.during = (start, stop)
        margin = resampling_margin(buffer.stamps for buffer in self._buffers.values())
        decoders = {
            topic: buffer.between(start - margin, stop + margin)
            for topic, buffer in self._buffers.items()
        }
        for buffer in self._buffers.values():
            buffer.drop_before(stop - LONGEST_MARGIN)
        tallies = {topic: buffer.tally for topic, buffer in self._buffers.items()}
        for topic, tally in tallies.items():
            if count := self._buffers[topic].decoder.decoded_singly:
                tally.counts[Defect.OTHER_LAYOUT] = count
        recorded = {
            topic.name: _during(self._stamps(topic, decoder), start, stop)
            for topic, decoder in decoders.items()
        }
        silent = [topic.name for topic, decoder in decoders.items() if not decoder.count]
        streams, fault = None, ""
        if silent:
            fault = (
                f"{self._source}: {', '.join(silent)} was silent up to {seconds(stop)}, or is "
                "stamped by another clock; record it again or leave it out"
            )
        else:
            streams = build_streams(self._source, self._chosen, decoders, tallies)
        return Slice(start, stop, streams, recorded, tuple(tallies.values()), fault)

    def _stamps(self, topic: Topic, decoder: TopicDecoder) -> IntArray:
        """Return header stamps in order of recording; each once if joints come in groups."""
        recorded = read_stamps(decoder)
        is_split = (
            topic in self._chosen.joints
            and len(group_joints(decoder, frozenset(self._chosen.joint_names))) > 1
        )
        return np.unique(recorded) if is_split else recorded


def _during(stamp: IntArray, start: int, stop: int) -> IntArray:
    return stamp[(stamp >= start) & (stamp < stop)]
