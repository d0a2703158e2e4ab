"""Live messages cut along the clock: whole blocks, and what has come since."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.bags.streams.selection import SelectedTopics
from symbid_ros.errors import SymbidError
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.signals.alignment import Segment, cut_to
from symbid_ros.signals.samples import moving_segments
from symbid_ros.signals.weak_form import BLOCK, prefilter

# Beyond the ends of a stretch, ns: what a spline needs that resamples a slower topic.
MARGIN = 100_000_000
# So many times as long as what a filter loses at one end must a piece be to be worth its while.
EDGES = 8
# Of so many blocks what is no piece yet is kept; who asks so seldom can wait for the blocks.
MOST_LEFT = 4


@dataclass(frozen=True)
class Stretch:
    """A stretch of time, aligned.

    Attributes
    ----------
    start, stop : int
        From where up to where, ns.
    segments : tuple of Segment
        What is in it.
    fault : str
        Why there is nothing in it; empty if there is.
    """

    start: int
    stop: int
    segments: tuple[Segment, ...]
    fault: str = ""


class Timeline:
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
        self.streams = LiveStreams(replace(selected, joint_names=model.joint_names), source)
        self._model = model
        self._lag = max(round(lag * 1e9), MARGIN)
        self._open_from: int | None = None
        self._piece_from: int | None = None
        self._left: deque[Stretch] = deque(maxlen=MOST_LEFT)

    def restart(self) -> Stretch | None:
        """Begin a new time and return what was left of the old one."""
        left = self.rest()
        self.streams.restart()
        self._open_from = self._piece_from = None
        self._left.clear()
        return left

    @property
    def newest(self) -> int | None:
        """Stamp of the newest joint state, ns; None before the first."""
        return self.streams.joints.newest

    def whole(self) -> Iterator[Stretch]:
        """Yield the blocks that are whole by now, each once."""
        while (start := self._block()) is not None and self._is_whole(start + BLOCK):
            stop = start + BLOCK
            block = self._stretch(start, stop, stop + MARGIN)
            yield block
            self._leave(block)
            for buffer in self.streams.buffers.values():
                buffer.count_gaps(stop)
            self.streams.worked_until = stop
            self.streams.forget_before(stop - MARGIN)
            stamps = self.streams.joints.stamps
            later = stamps[stamps >= stop]
            self._open_from = int(later.min()) if len(later) else stop

    def pieces(self) -> Iterator[Stretch]:
        """Yield what every topic has told since the last time; no piece lies in two blocks.

        What would be too short waits for more, unless its block ends. Of blocks given out
        meanwhile, which take their time to be worked on, what was no piece yet comes first.
        """
        while self._left:
            yield self._left.popleft()
        until = self.streams.complete_until
        while until is not None and (block := self._block()) is not None:
            start = max(block, self._piece_from or block)
            end = (start // BLOCK + 1) * BLOCK
            stop = min(until + 1, end)
            if stop - start < (0 if stop == end else self._shortest_piece()):
                return
            self._piece_from = stop
            yield self._stretch(start, stop, stop)

    def _leave(self, block: Stretch) -> None:
        start = max(block.start, self._piece_from or block.start)
        if start < block.stop:
            segments = tuple(cut_to(block.segments, start, block.stop))
            self._left.append(replace(block, start=start, segments=segments))

    def _shortest_piece(self) -> int:
        # Joints may come in parts, several messages of one stamp.
        stamps = np.unique(self.streams.joints.stamps)
        if len(stamps) < 2:
            return BLOCK
        period = float(np.median(np.diff(stamps)))
        _, edge = prefilter(1e9 / max(period, 1.0))
        return int(EDGES * edge * period)

    def rest(self) -> Stretch | None:
        """Return what is open: all that has come since the last whole block."""
        until, start = self.streams.complete_until, self._block()
        if until is None or start is None or until < start:
            return None
        # Topics that are ahead help to interpolate up to the last instant, as in a bag.
        return self._stretch(start, until + 1, until + 1 + MARGIN)

    def _block(self) -> int | None:
        """Return where the block begins that is being filled, ns."""
        if self.newest is None:  # messages without stamps have been dropped again
            self._open_from = self._piece_from = None
        if self._open_from is None:
            stamps = self.streams.joints.stamps
            if not len(stamps):
                return None
            self._open_from = int(stamps.min())
        return self._open_from // BLOCK * BLOCK

    def _is_whole(self, stop: int) -> bool:
        newest, complete = self.newest, self.streams.complete_until
        if newest is not None and newest >= stop + self._lag:
            return True
        return complete is not None and complete >= stop + MARGIN

    def _stretch(self, start: int, stop: int, seen_until: int) -> Stretch:
        try:
            streams = self.streams.between(start - MARGIN, seen_until)
            segments = moving_segments(streams, self._model)
        except SymbidError as error:
            return Stretch(start, stop, (), str(error))
        return Stretch(start, stop, tuple(cut_to(segments, start, stop)))
