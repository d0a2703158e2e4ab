"""Bags into streams of arrays, slice by slice of time, so that a long log need not be held."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.bags.container.blocks import MessageBlock
from symbid_ros.bags.container.files import count_messages, join_names, read_blocks
from symbid_ros.bags.streams.reorder_buffer import ReorderBuffer
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.sensor_streams import group_joints, sensor_streams, stamps
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection, TopicSelector
from symbid_ros.signals.alignment import LONGEST_MARGIN, resampling_margin
from symbid_ros.signals.defects import ALWAYS, Defect
from symbid_ros.signals.stamps import CLOCK_JUMP, seconds
from symbid_ros.signals.streams import ALL_OF_IT, Slice, TimeRange

# Bytes that may wait for a topic that lags; it is silent or recorded behind the others.
MOST_WAITING = 256 << 20


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
        Bag folders or files that continue one another; separate runs are to be read separately.
    topics : TopicSelection
        Topics to read.
    span : int, optional
        Length of the slices, ns: they end at multiples of it. One slice of everything without.
    part : TimeRange
        What to read.
    warn : bool
        Whether to tell at the end what was mended on the way.

    Raises
    ------
    BagError, DataError
        When a bag or what it holds cannot be used.
    """
    source = join_names(bags)
    slicer = _Slicer(
        source, TopicSelector(source, topics, count_messages(bags)).selected(), span, part
    )
    for block in read_blocks(bags):
        slicer.add(block)
        yield from slicer.whole()
        if slicer.is_done:
            break
    else:
        yield from slicer.rest()
    if warn:
        slicer.report()


class _Slicer:
    """What has been read and waits, and how far slices have been given out."""

    def __init__(
        self, source: str, chosen: SelectedTopics, span: int | None, part: TimeRange
    ) -> None:
        self._source, self._chosen, self._span, self._part = source, chosen, span, part
        self._backlogs = {topic: ReorderBuffer.of(source, topic) for topic in chosen.all}
        self._joints = self._backlogs[chosen.clock]
        self._until, self._end = ALWAYS
        self._begin = self._until  # of the part that is wanted
        self._has_begun = False

    @property
    def is_done(self) -> bool:
        """Whether nothing that follows is wanted."""
        return self._until >= self._end

    def add(self, block: MessageBlock) -> None:
        """Take the messages of a block."""
        for topic, backlog in self._backlogs.items():
            if topic in block.spans:
                backlog.add(block.data, block.spans[topic], self._until, self._begin)
        if not self._has_begun and (first := self._joints.first_from(ALWAYS[0])) is not None:
            self._has_begun = True
            if self._part.start > 0:
                self._until = self._begin = first + round(1e9 * self._part.start)
            if np.isfinite(self._part.stop):
                self._end = first + round(1e9 * self._part.stop)

    def whole(self) -> Iterator[Slice]:
        """Yield the slices that nothing will be added to."""
        while self._span is not None and (stop := self._stop()) is not None:
            newest = min(backlog.newest or ALWAYS[0] for backlog in self._backlogs.values())
            waiting = sum(backlog.size for backlog in self._backlogs.values())
            if newest < stop + LONGEST_MARGIN + CLOCK_JUMP and waiting < MOST_WAITING:
                return
            yield self._slice(stop)

    def rest(self) -> Iterator[Slice]:
        """Yield what is left at the end of the bags."""
        while (stop := self._stop()) is not None:
            yield self._slice(stop)

    def report(self) -> None:
        """Warn of what was mended."""
        for backlog in self._backlogs.values():
            backlog.tally.report()

    def _stop(self) -> int | None:
        """Return where the slice ends that the next joint state belongs to, ns."""
        first = None if self.is_done else self._joints.first_from(self._until)
        if first is None or first >= self._end:
            return None
        if self._span is None:
            return self._end
        return min((first // self._span + 1) * self._span, self._end)

    def _slice(self, stop: int) -> Slice:
        start, self._until = self._until, stop
        for backlog in self._backlogs.values():
            backlog.tally.during = (start, stop)
        margin = resampling_margin(backlog.stamps for backlog in self._backlogs.values())
        decoders = {
            topic: backlog.between(start - margin, stop + margin)
            for topic, backlog in self._backlogs.items()
        }
        for backlog in self._backlogs.values():
            backlog.drop_before(stop - LONGEST_MARGIN)
        tallies = {topic: backlog.tally for topic, backlog in self._backlogs.items()}
        for topic, tally in tallies.items():
            if singly := self._backlogs[topic].decoder.decoded_singly:
                tally.counts[Defect.OTHER_LAYOUT] = singly
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
            streams = sensor_streams(self._source, self._chosen, decoders, tallies)
        return Slice(start, stop, streams, recorded, tuple(tallies.values()), fault)

    def _stamps(self, topic: Topic, decoder: TopicDecoder) -> IntArray:
        """Return header stamps in order of recording, each once where joints come in parts."""
        recorded = stamps(decoder)
        is_parted = (
            topic in self._chosen.joints
            and len(group_joints(decoder, frozenset(self._chosen.joint_names))) > 1
        )
        return np.unique(recorded) if is_parted else recorded


def _during(stamp: IntArray, start: int, stop: int) -> IntArray:
    return stamp[(stamp >= start) & (stamp < stop)]
