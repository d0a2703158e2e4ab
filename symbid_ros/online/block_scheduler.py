"""Cuts live messages into complete blocks of clock time and into partial blocks."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from symbid_ros.arrays import distinct
from symbid_ros.errors import SymbidError
from symbid_ros.identification.rows.accumulator import TimeSpan
from symbid_ros.messages.topics import SelectedTopics
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.signals.alignment import (
    LONGEST_MARGIN,
    SHORTEST_SEGMENT,
    align_checked,
    resampling_margin,
)
from symbid_ros.signals.defects import typical_period
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.weak_form import block_length, prefilter

# A partial block is at least this many times as long as what the filter discards at one end.
MIN_EDGES = 8
# Unread ends of at most this many blocks are kept for `partial_blocks`.
MAX_UNREAD_ENDS = 4


class BlockScheduler:
    """Cuts the messages of a robot's topics into the same blocks as an offline run.

    Parameters
    ----------
    selected : SelectedTopics
        The robot's sensors.
    model : RobotModel
        Kinematics and frames.
    lag : float
        How long to wait for a topic that lags behind the joint states, s. After that, its block
        is released without the missing messages.
    source : str
        Name of the topics in messages to the user.

    Attributes
    ----------
    streams : LiveStreams
        Buffered messages.
    """

    def __init__(
        self, selected: SelectedTopics, model: RobotModel, lag: float, source: str
    ) -> None:
        self.streams = LiveStreams(
            replace(
                selected,
                joint_names=model.measured_joint_names,
                linear_joints=model.prismatic_joint_names,
                is_live=True,
            ),
            source,
            round(lag * 1e9),
        )
        self._model = model
        # Poses are low-passed and differentiated, so more of them are needed.
        self._least_margin = LONGEST_MARGIN if selected.poses else 0
        self._period: float | None = None  # of the joint states, ns; None until enough arrived
        self._open_from: int | None = None
        self._unread_from: int | None = None
        self._unread_ends: deque[TimeSpan] = deque(maxlen=MAX_UNREAD_ENDS)

    def restart(self) -> TimeSpan | None:
        """Restart after a clock jump and return the open block of the old clock."""
        open_block = self.open_block()
        self.streams.restart()
        self._open_from = self._unread_from = self._period = None
        self._unread_ends.clear()
        return open_block

    @property
    def newest(self) -> int | None:
        """Stamp of the newest joint state, ns; None before the first."""
        return self.streams.joints.newest

    def complete_blocks(self) -> Iterator[TimeSpan]:
        """Yield each block once, as soon as it is complete."""
        while (bounds := self._open_bounds()) is not None:
            start, stop = bounds
            margin = self._margin_after(stop)
            if margin is None:
                return
            block = self._align(start, stop, stop + margin)
            yield block
            self._keep_unread_end(block)
            for buffer in self.streams.buffers.values():
                buffer.count_gaps(stop)
            self.streams.released_until = stop
            self.streams.drop_before(stop - LONGEST_MARGIN)
            stamps = self.streams.joints.stamps
            later = stamps[stamps >= stop]
            self._open_from = int(later.min()) if len(later) else stop

    def partial_blocks(self) -> Iterator[TimeSpan]:
        """Yield the time spans that every topic has covered since the last call.

        No span crosses a block boundary. A span that is too short waits for more messages unless
        its block ends. Unread ends of blocks that were completed meanwhile come first.
        """
        while self._unread_ends:
            yield self._unread_ends.popleft()
        until = self.streams.complete_until
        if until is not None:
            until -= self._least_margin
        while until is not None and (bounds := self._open_bounds()) is not None:
            start = max(bounds[0], self._unread_from or bounds[0])
            end = start // (length := bounds[1] - bounds[0]) * length + length
            stop = min(until + 1, end)
            if stop - start < (0 if stop == end else self._shortest_partial_block()):
                return
            self._unread_from = stop
            yield self._align(start, stop, stop + self._least_margin)

    def _keep_unread_end(self, block: TimeSpan) -> None:
        start = max(block.start, self._unread_from or block.start)
        if start < block.stop:
            segments = tuple(cut_to(block.segments, start, block.stop))
            self._unread_ends.append(replace(block, start=start, segments=segments))

    def open_block(self) -> TimeSpan | None:
        """Return the open block: all messages since the last complete one."""
        until, bounds = self.streams.complete_until, self._open_bounds()
        if until is None or bounds is None or until < bounds[0]:
            return None
        # Later messages of other topics allow interpolation up to the last stamp, as in a bag.
        return self._align(bounds[0], until + 1, until + 1 + LONGEST_MARGIN)

    def _open_bounds(self) -> tuple[int, int] | None:
        """Return start and end of the block that is being filled, ns."""
        if self.newest is None:  # messages without stamps were dropped
            self._open_from = self._unread_from = self._period = None
        stamps = self.streams.joints.stamps
        if self._period is None:
            if len(stamps) < SHORTEST_SEGMENT:
                return None
            # Several messages with one stamp may each hold some of the joints.
            if (period := typical_period(distinct(stamps))) <= 0:
                return None
            self._period = period
        if self._open_from is None:
            self._open_from = int(stamps.min())
        length = block_length(1e9 / self._period)
        start = self._open_from // length * length
        return start, start + length

    def _is_too_short(self, start: int, stop: int) -> bool:
        """Return whether a time since the first message is too short for a segment of any rate."""
        if self._period is None or self._open_from is None:
            return False
        shortest = SHORTEST_SEGMENT * self._period
        is_possible = block_length(1e9 / self._period) >= shortest
        return is_possible and stop - max(start, self._open_from) < shortest

    def _shortest_partial_block(self) -> int:
        period = self._period or 1.0
        _, edge = prefilter(1e9 / period)
        return int(MIN_EDGES * edge * period)

    def _margin_after(self, stop: int) -> int | None:
        """Return how long after its end a block needs messages, ns; None while it is incomplete."""
        newest, complete = self.newest, self.streams.complete_until
        if newest is None or newest < stop:
            return None
        buffers = self.streams.buffers.values()
        margin = max(self._least_margin, resampling_margin(buffer.stamps for buffer in buffers))
        is_complete = complete is not None and complete >= stop + margin
        return margin if is_complete or newest >= stop + max(self.streams.lag, margin) else None

    def _align(self, start: int, stop: int, messages_until: int) -> TimeSpan:
        try:
            margin = max(
                self._least_margin,
                resampling_margin(each.stamps for each in self.streams.buffers.values()),
            )
            streams = self.streams.between(start - margin, messages_until)
            segments = align_checked(streams, self._model)
        except SymbidError as error:
            return TimeSpan(start, stop, (), "" if self._is_too_short(start, stop) else str(error))
        return TimeSpan(start, stop, tuple(cut_to(segments, start, stop)))
