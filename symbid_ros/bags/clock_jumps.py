"""Jumps back of a bag's clock, which are harmless outside the part that is read."""

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.signals.defects import CLOCK_JUMP, Defect, DefectError, seconds
from symbid_ros.signals.segments import SECOND
from symbid_ros.signals.streams import TimeRange


@dataclass
class ClockJumps:
    """Shifts the stamps after a backward jump so that they follow those before it.

    The requested part must end before the jump or begin after it. The stamps of all topics are
    shifted by the same whole seconds, which keeps the topics aligned. `start` and `stop` still
    count from the first joint state.

    Attributes
    ----------
    source, clock : str
        Names of the log and of its topic of joint states.
    part : TimeRange
        Requested part.
    first : int or None
        Stamp of the first joint state, ns; None until it is read.
    moves : list of int
        By how much stamps move after each jump of the recording, ns.
    """

    source: str
    clock: str
    part: TimeRange
    first: int | None = None
    moves: list[int] = field(default_factory=list)
    _passed: Counter[str] = field(default_factory=Counter)
    _alone: dict[str, DefectError] = field(default_factory=dict)

    def begin(self) -> None:
        """Begin with a further recording, in which no clock has jumped."""
        self.moves.clear()
        self._passed.clear()
        self._alone.clear()

    def continued(self, topic: str, last: IntArray, stamps: IntArray) -> IntArray:
        """Return the stamps (N,) of a topic's next messages, ns, without jumps back.

        ``last`` holds the topic's previous stamp, if any, as returned.

        Raises
        ------
        DefectError
            When a jump lies in the requested part, or only this topic's clock jumps.
        """
        moved = stamps + sum(self.moves[: self._passed[topic]])
        while len(jumps := np.flatnonzero(np.diff(np.append(last, moved)) < -CLOCK_JUMP)):
            after = int(jumps[0]) + 1 - len(last)
            before = int(moved[after - 1] if after else last[0])
            back = before - int(moved[after])
            # Messages of other topics may be rarer than joint states.
            near = 0 if topic == self.clock else CLOCK_JUMP
            passed = self._passed[topic]
            if passed == len(self.moves):
                self.moves.append((back // SECOND + 2) * SECOND)
            move = self.moves[passed]
            is_same = CLOCK_JUMP // 2 < move - back <= 3 * CLOCK_JUMP
            if self.first is None or not is_same:
                raise self._error(topic, before, back)
            elapsed = before - self.first
            if self.part.start > 0 and elapsed <= 1e9 * self.part.start + near:
                self._alone[topic] = self._error(topic, before, back, is_alone=True)
            elif elapsed + near < 1e9 * self.part.stop:
                raise self._error(topic, before, back)
            moved[after:] += move
            self._passed[topic] += 1
        return moved

    def check(self) -> None:
        """Refuse to read on after a jump of a topic that the joint states did not share."""
        for topic, error in self._alone.items():
            if self._passed[topic] > self._passed[self.clock]:
                raise error

    def _error(self, topic: str, before: int, back: int, *, is_alone: bool = False) -> DefectError:
        what = (
            f"{self.source}: {topic}: header stamps jump back by {seconds(back)} after "
            f"{seconds(before)}"
        )
        advice = "record each run in a bag of its own"
        if self.first is not None:
            elapsed = (before - self.first) / 1e9
            what += f", {elapsed:.1f} s from the first joint state"
            # To a tenth of a second, because other topics jump a few messages earlier or later.
            stop, start = math.floor(10 * elapsed) / 10, math.ceil(10 * elapsed + 1) / 10
            ways = [f"`stop` {stop:.1f} to use what comes before"] if stop > 0 else []
            if is_alone:
                what += f"; those of {self.clock} do not"
            elif start > 0:
                ways.append(f"`start` {start:.1f} to use what follows")
            if ways:
                advice = f"give {' or '.join(ways)}, or {advice}"
        return DefectError(topic, Defect.CLOCK_JUMP, f"{what}; {advice}", "E314")


def earliest_before_jump(stamps: IntArray) -> int:
    """Return the smallest of stamps (N,), ns in order of recording, before the clock jumps back."""
    jumps = np.flatnonzero(np.diff(stamps) < -CLOCK_JUMP)
    return int(stamps[: jumps[0] + 1 if len(jumps) else None].min())
