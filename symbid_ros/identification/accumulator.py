"""Rows of live messages, accumulated: complete blocks, and pieces of the open block."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.estimation.observations import Observations
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


@dataclass(frozen=True)
class Whole:
    """What whole blocks have told.

    Attributes
    ----------
    observations : tuple of Observations
        For each length of window.
    span : float
        Time in which a row loses all but 1/e of its weight, s.
    until : int or None
        End of the last block, ns; None where a new time begins.
    blocks : int
        How many there were.
    """

    observations: tuple[Observations, ...]
    span: float
    until: int | None = None
    blocks: int = 0

    def with_block(self, block: BlockRows) -> "Whole":
        """Return what is known with one block more."""
        share = self.kept(block.stop, block.start)
        folded = tuple(
            _folded(one, share, block.of_window(one.window)).covering(block.seconds)
            for one in self.observations
        )
        return replace(self, observations=folded, until=block.stop, blocks=self.blocks + 1)

    def new_time(self) -> "Whole":
        """Return the same for a clock that begins again."""
        return replace(self, until=None)

    def kept(self, stop: int, start: int) -> float:
        """Return what is left at ``stop`` of these rows' weight; a new time begins at ``start``."""
        return _kept(stop - (start if self.until is None else self.until), self.span)


class Memory:
    """Whole blocks, and over one length of windows the pieces that have come since.

    Parameters
    ----------
    whole : Whole
        What is known at the beginning.
    window : int
        Index of that length.

    Attributes
    ----------
    whole : Whole
        Of whole blocks alone.
    now : Observations
        With pieces.
    window : int
        Index of the length of windows of ``now``.
    """

    def __init__(self, whole: Whole, window: int) -> None:
        self.track(whole, window)

    def track(self, whole: Whole, window: int) -> None:
        """Begin with what is known, over another length of windows; pieces are let go of."""
        self.whole, self.window = whole, window
        self.now = whole.observations[window]
        self._until = whole.until
        self._pieces: list[BlockRows] = []

    def add(self, piece: BlockRows) -> None:
        """Take a piece, of one length of windows, until its block is whole."""
        self._pieces.append(piece)
        self._append(piece)

    def settle(self, whole: Whole) -> None:
        """Take what is known with the next whole block, in place of its pieces."""
        later = [piece for piece in self._pieces if piece.start >= (whole.until or 0)]
        self.track(whole, self.window)
        for piece in later:
            self.add(piece)

    def _append(self, piece: BlockRows) -> None:
        since = piece.start if self._until is None else self._until
        share = _kept(piece.stop - since, self.whole.span)
        self.now = _folded(self.now, share, piece.of_window(self.now.window))
        self._until = piece.stop


def _kept(elapsed: int, span: float) -> float:
    return float(np.exp(-elapsed * 1e-9 / span))


def _folded(one: Observations, share: float, rows: Sequence[WindowedRows]) -> Observations:
    return (one if share == 1.0 else one.discounted(share)).fold(rows)
