"""Live messages cut along the clock: whole blocks, and what has come since."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from symbid_ros.errors import SymbidError
from symbid_ros.identification.accumulator import TimeSpan
from symbid_ros.messages.topics import SelectedTopics
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.signals.alignment import (
    LONGEST_MARGIN,
    SHORTEST_SEGMENT,
    align_checked,
    resampling_margin,
)
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.weak_form import block_length, prefilter

# So many times as long as what a filter loses at one end must a piece be to be worth its while.
EDGES = 8
# Of so many blocks what is no piece yet is kept; who asks so seldom can wait for the blocks.
MOST_LEFT = 4


class BlockScheduler:
    """Messages of a robot's topics, cut where an offline run cuts.

    Parameters
    ----------
    selected : SelectedTopics
        The robot's sensors.
    model : RobotModel
        Kinematics and frames.
    lag : float
        How long a topic may lag behind the joint states before a block is given out without what
        is missing, s.
    source : str
        How messages to the user name the topics.

    Attributes
    ----------
    streams : LiveStreams
        What has come.
    """

    def __init__(
        self, selected: SelectedTopics, model: RobotModel, lag: float, source: str
    ) -> None:
        self.streams = LiveStreams(
            replace(selected, joint_names=model.measured_joint_names), source
        )
        self._model = model
        self._lag = round(lag * 1e9)
        self._period: float | None = None  # of the joint states, ns, once enough have come
        self._open_from: int | None = None
        self._piece_from: int | None = None
        self._left: deque[TimeSpan] = deque(maxlen=MOST_LEFT)

    def restart(self) -> TimeSpan | None:
        """Begin a new time and return what was left of the old one."""
        left = self.rest()
        self.streams.restart()
        self._open_from = self._piece_from = self._period = None
        self._left.clear()
        return left

    @property
    def newest(self) -> int | None:
        """Stamp of the newest joint state, ns; None before the first."""
        return self.streams.joints.newest

    def whole(self) -> Iterator[TimeSpan]:
        """Yield the blocks that are whole by now, each once."""
        while (place := self._block()) is not None:
            start, stop = place
            margin = self._margin_after(stop)
            if margin is None:
                return
            block = self._stretch(start, stop, stop + margin)
            yield block
            self._leave(block)
            for buffer in self.streams.buffers.values():
                buffer.count_gaps(stop)
            self.streams.worked_until = stop
            self.streams.forget_before(stop - LONGEST_MARGIN)
            stamps = self.streams.joints.stamps
            later = stamps[stamps >= stop]
            self._open_from = int(later.min()) if len(later) else stop

    def pieces(self) -> Iterator[TimeSpan]:
        """Yield what every topic has told since the last time; no piece lies in two blocks.

        What would be too short waits for more, unless its block ends. Of blocks given out
        meanwhile, which take their time to be worked on, what was no piece yet comes first.
        """
        while self._left:
            yield self._left.popleft()
        until = self.streams.complete_until
        while until is not None and (place := self._block()) is not None:
            start = max(place[0], self._piece_from or place[0])
            end = start // (length := place[1] - place[0]) * length + length
            stop = min(until + 1, end)
            if stop - start < (0 if stop == end else self._shortest_piece()):
                return
            self._piece_from = stop
            yield self._stretch(start, stop, stop)

    def _leave(self, block: TimeSpan) -> None:
        start = max(block.start, self._piece_from or block.start)
        if start < block.stop:
            segments = tuple(cut_to(block.segments, start, block.stop))
            self._left.append(replace(block, start=start, segments=segments))

    def rest(self) -> TimeSpan | None:
        """Return what is open: all that has come since the last whole block."""
        until, place = self.streams.complete_until, self._block()
        if until is None or place is None or until < place[0]:
            return None
        # Topics that are ahead help to interpolate up to the last instant, as in a bag.
        return self._stretch(place[0], until + 1, until + 1 + LONGEST_MARGIN)

    def _block(self) -> tuple[int, int] | None:
        """Return where the block begins and ends that is being filled, ns."""
        if self.newest is None:  # messages without stamps have been dropped again
            self._open_from = self._piece_from = self._period = None
        stamps = self.streams.joints.stamps
        if self._period is None:
            if len(stamps) < SHORTEST_SEGMENT:
                return None
            # Joints may come in parts, several messages of one stamp.
            steps = np.diff(np.unique(stamps))
            if not len(steps):
                return None
            self._period = float(np.median(steps))
        if self._open_from is None:
            self._open_from = int(stamps.min())
        length = block_length(1e9 / self._period)
        start = self._open_from // length * length
        return start, start + length

    def _shortest_piece(self) -> int:
        period = self._period or 1.0
        _, edge = prefilter(1e9 / period)
        return int(EDGES * edge * period)

    def _margin_after(self, stop: int) -> int | None:
        """Return what of the time after a block, ns, belongs to it; None while it is not whole."""
        newest, complete = self.newest, self.streams.complete_until
        if newest is None or newest < stop:
            return None
        buffers = self.streams.buffers.values()
        margin = resampling_margin(buffer.stamps for buffer in buffers)
        is_complete = complete is not None and complete >= stop + margin
        return margin if is_complete or newest >= stop + max(self._lag, margin) else None

    def _stretch(self, start: int, stop: int, seen_until: int) -> TimeSpan:
        try:
            margin = resampling_margin(each.stamps for each in self.streams.buffers.values())
            streams = self.streams.between(start - margin, seen_until)
            segments = align_checked(streams, self._model)
        except SymbidError as error:
            return TimeSpan(start, stop, (), str(error))
        return TimeSpan(start, stop, tuple(cut_to(segments, start, stop)))
