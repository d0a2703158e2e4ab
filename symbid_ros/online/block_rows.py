"""The rows of one stretch of live messages."""

from collections.abc import Sequence
from dataclasses import dataclass

from symbid_ros.online.timeline import Stretch
from symbid_ros.signals.fingerprint import fingerprint
from symbid_ros.signals.noise_floor import MOTION, Channel
from symbid_ros.signals.weak_form import RowBuilder, WindowedRows, windowed_rows


@dataclass(frozen=True)
class BlockRows:
    """The rows of one stretch of time, for each length of window.

    Attributes
    ----------
    start, stop : int
        From where up to where, ns.
    rows : tuple of tuple of WindowedRows
        Part by part, in each part window by window.
    seconds : frozenset of int
        Fingerprints of the seconds covered.
    """

    start: int
    stop: int
    rows: tuple[tuple[WindowedRows, ...], ...]
    seconds: frozenset[int] = frozenset()

    def of_window(self, index: int) -> tuple[WindowedRows, ...]:
        """Return the rows of one length of window."""
        return tuple(part[index] for part in self.rows)


def block_rows(
    stretch: Stretch,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
) -> BlockRows:
    """Return the rows of a stretch, as an offline run makes them."""
    parts = [
        part
        for segment in stretch.segments
        for part in windowed_rows(segment, build, windows, noisy_channels)
    ]
    seconds = frozenset[int]().union(*map(fingerprint, stretch.segments))
    return BlockRows(stretch.start, stretch.stop, tuple(parts), seconds)
