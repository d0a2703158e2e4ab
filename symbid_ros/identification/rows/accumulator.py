"""Rows of live messages, accumulated: complete blocks, and pieces of the open block."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.estimation.observations import Observations
from symbid_ros.signals.sampled_rows import RowBuilder
from symbid_ros.signals.segments import Segment, fingerprint
from symbid_ros.signals.sensor_noise import MOTION, Channel
from symbid_ros.signals.weak_form import WindowedRows, suitable_windows, windowed_rows


@dataclass(frozen=True)
class TimeSpan:
    """Aligned sensor data between two stamps.

    Attributes
    ----------
    start, stop : int
        First stamp, and the stamp at which the next span starts, ns.
    segments : tuple of Segment
    fault : str
        The reason for missing segments; empty if there are segments.
    """

    start: int
    stop: int
    segments: tuple[Segment, ...]
    fault: str = ""


@dataclass(frozen=True)
class BlockRows:
    """The rows of one time span.

    Attributes
    ----------
    start, stop : int
        As in :class:`TimeSpan`, ns.
    by_window : mapping of float to list of WindowedRows
        For each window length, s, that suits the rate: one element for each part of a segment.
    seconds : frozenset of int
        Fingerprints of the seconds covered.
    first : int or None
        First stamp of the log, ns; None if there are no segments so far.
    """

    start: int
    stop: int
    by_window: Mapping[float, Sequence[WindowedRows]]
    seconds: frozenset[int] = frozenset()
    first: int | None = None

    def of_window(self, window: float) -> Sequence[WindowedRows]:
        """Return the rows of one window length, s."""
        return self.by_window.get(window, ())

    def slipping(self) -> "BlockRows":
        """Return the same span without the rows of joints that may stick."""
        rows = {window: [one.slipping() for one in rows] for window, rows in self.by_window.items()}
        return replace(self, by_window=rows)

    @property
    def parts(self) -> list[WindowedRows]:
        """The rows of all window lengths."""
        return [part for parts in self.by_window.values() for part in parts]


def build_block_rows(
    data: TimeSpan,
    build: RowBuilder,
    windows: Sequence[float],
    noisy_channels: Sequence[Channel] = MOTION,
    *,
    first: int | None = None,
    replays_all: bool = False,
) -> BlockRows:
    """Return the rows of a time span, equal to those of an offline run.

    ``first`` is the first stamp of the log, ns, by default that of this span. From there on noise
    is replayed in fewer and fewer blocks, unless in all.
    """
    if first is None and data.segments:
        first = int(data.segments[0].stamp[0])
    replayed_from = None if replays_all else first
    rows: dict[float, list[WindowedRows]] = defaultdict(list)
    for segment in data.segments:
        used = suitable_windows(windows, segment.rate)
        for parts in windowed_rows(segment, build, used, noisy_channels, first=replayed_from):
            for window, part in zip(used, parts, strict=True):
                rows[window].append(part)
    seconds = frozenset[int]().union(*map(fingerprint, data.segments))
    return BlockRows(data.start, data.stop, dict(rows), seconds, first)


@dataclass(frozen=True)
class BlockAccumulator:
    """Information from complete blocks.

    Attributes
    ----------
    observations : tuple of Observations
        One for each window length.
    time_constant : float
        Time in which the weight of a row falls to 1/e, s.
    stop : int or None
        End of the last block, ns; None if there is none, or none since a clock jumped back.
    count : int
        Number of blocks.
    first : int or None
        First stamp of the log, ns; None before the first segment.
    """

    observations: tuple[Observations, ...]
    time_constant: float
    stop: int | None = None
    count: int = 0
    first: int | None = None

    def rows(
        self,
        data: TimeSpan,
        build: RowBuilder,
        windows: Sequence[float],
        noisy_channels: Sequence[Channel] = MOTION,
    ) -> BlockRows:
        """Return the rows of the next block."""
        # Rows that are forgotten must be represented by newer ones.
        forgets = self.time_constant < np.inf
        return build_block_rows(
            data, build, windows, noisy_channels, first=self.first, replays_all=forgets
        )

    def with_block(self, block: BlockRows) -> "BlockAccumulator":
        """Return the information with one more block."""
        since = block.start if self.stop is None else self.stop
        weight = _remaining_weight(block.stop - since, self.time_constant)
        observations = tuple(
            _fold(one, weight, block.of_window(one.window)).covering(block.seconds)
            for one in self.observations
        )
        first = block.first if self.first is None else self.first
        return replace(
            self, observations=observations, stop=block.stop, count=self.count + 1, first=first
        )

    def with_new_clock(self) -> "BlockAccumulator":
        """Return the same information; the stamps of later blocks start anywhere."""
        return replace(self, stop=None, first=None)


class Accumulator:
    """Information from complete blocks, and for one window length from the pieces since then.

    Parameters
    ----------
    blocks : BlockAccumulator
        Initial information.
    window : int
        Index of that window length.

    Attributes
    ----------
    blocks : BlockAccumulator
        Complete blocks only.
    current : Observations
        Blocks and pieces.
    window : int
        Index of the window length of ``current``.
    """

    def __init__(self, blocks: BlockAccumulator, window: int) -> None:
        self.restart(blocks, window)

    def restart(self, blocks: BlockAccumulator, window: int) -> None:
        """Replace the information, perhaps with another window length; pieces are discarded."""
        self.blocks, self.window = blocks, window
        self.current = blocks.observations[window]
        self._stop = blocks.stop
        self._pieces: list[BlockRows] = []

    def add(self, piece: BlockRows) -> None:
        """Add a piece, which counts until its block is complete."""
        self._pieces.append(piece)
        since = piece.start if self._stop is None else self._stop
        weight = _remaining_weight(piece.stop - since, self.blocks.time_constant)
        current = self.current if weight == 1.0 else self.current.discounted(weight)
        rows = piece.of_window(current.window)
        # Without a complete block, joint terms are chosen from the pieces, which needs all moments.
        self.current = current.with_few(rows) if self.blocks.count else current.fold(rows)
        self._stop = piece.stop

    def update_blocks(self, blocks: BlockAccumulator) -> None:
        """Take over the information with further blocks, which replace their pieces."""
        later = [piece for piece in self._pieces if piece.start >= (blocks.stop or 0)]
        self.restart(blocks, self.window)
        for piece in later:
            self.add(piece)


def _remaining_weight(elapsed: int, time_constant: float) -> float:
    return float(np.exp(-elapsed * 1e-9 / time_constant))


def _fold(one: Observations, weight: float, rows: Sequence[WindowedRows]) -> Observations:
    return (one if weight == 1.0 else one.discounted(weight)).fold(rows)
