"""The rows of one stretch of live messages."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from symbid_ros.signals.noise_floor import MOTION, Channel
from symbid_ros.signals.segments import Segment, fingerprint
from symbid_ros.signals.weak_form import (
    RowBuilder,
    WindowedRows,
    suited_windows,
    windowed_rows,
)


@dataclass(frozen=True)
class TimeSpan:
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


@dataclass(frozen=True)
class BlockRows:
    """The rows of one stretch of time.

    Attributes
    ----------
    start, stop : int
        From where up to where, ns.
    by_window : mapping of float to list of WindowedRows
        Part by part, for each length of window, s, that suits the rate.
    seconds : frozenset of int
        Fingerprints of the seconds covered.
    """

    start: int
    stop: int
    by_window: Mapping[float, Sequence[WindowedRows]]
    seconds: frozenset[int] = frozenset()

    def of_window(self, window: float) -> Sequence[WindowedRows]:
        """Return the rows of one length of window, s."""
        return self.by_window.get(window, ())

    @property
    def parts(self) -> list[WindowedRows]:
        """The rows of all windows."""
        return [part for parts in self.by_window.values() for part in parts]


def block_rows(
    stretch: TimeSpan,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
) -> BlockRows:
    """Return the rows of a stretch, as an offline run makes them."""
    rows: dict[float, list[WindowedRows]] = defaultdict(list)
    for segment in stretch.segments:
        used = suited_windows(windows, segment.rate)
        for parts in windowed_rows(segment, build, used, noisy_channels):
            for window, part in zip(used, parts, strict=True):
                rows[window].append(part)
    seconds = frozenset[int]().union(*map(fingerprint, stretch.segments))
    return BlockRows(stretch.start, stretch.stop, dict(rows), seconds)
