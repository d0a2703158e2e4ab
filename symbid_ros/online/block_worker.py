"""Whole blocks, worked on beside everything else and without hurry."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event

from symbid_ros.identification.accumulator import BlockAccumulator, TimeSpan, build_block_rows
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.signals.weak_form import RowBuilder, SampledRows


class BlockWorker:
    """Blocks in line for a thread that takes a bounded share of a core.

    A block's rows come at once every few seconds and would keep whoever reads the topics waiting.

    Parameters
    ----------
    build : RowBuilder
        Makes rows of readings.
    windows : sequence of float
        Lengths of windows, s.
    share : float
        Of a core, above 0 and at most 1.
    whole : BlockAccumulator
        What is known before the first block.
    """

    def __init__(
        self, build: RowBuilder, windows: Sequence[float], share: float, whole: BlockAccumulator
    ) -> None:
        self._build, self._windows, self._share = build, tuple(windows), share
        self._whole = whole
        self._hurry = Event()
        self._pool = ThreadPoolExecutor(1, "blocks")
        self._line: list[Future[BlockAccumulator]] = []

    def put(self, block: TimeSpan) -> None:
        """Put a block in line."""
        self._line.append(self._pool.submit(self._worked, block))

    def done(self) -> BlockAccumulator | None:
        """Return what is known with the blocks that have been finished since the last time."""
        whole = None
        while self._line and self._line[0].done():
            whole = self._line.pop(0).result()
        return whole

    def finish(self) -> BlockAccumulator | None:
        """Return the same once no block is in line any more, as soon as it can be had."""
        self._hurry.set()
        for future in self._line:
            future.result()
        self._hurry.clear()
        return self.done()

    def begin(self, whole: BlockAccumulator) -> None:
        """Go on from what is known, with no block in line."""
        self._whole = whole

    def close(self) -> None:
        """Give up what is in line."""
        self._hurry.set()
        self._pool.shutdown(cancel_futures=True)

    def _worked(self, block: TimeSpan) -> BlockAccumulator:
        rows = build_block_rows(block, self._paced, self._windows)
        # Nobody else touches it while blocks are in line, which are worked on one by one.
        self._whole = self._whole.with_block(rows)
        return self._whole

    def _paced(self, readings: SensorSamples) -> Iterator[SampledRows]:
        began = time.thread_time()
        for part in self._build(readings):
            yield part
            spent = time.thread_time() - began
            self._hurry.wait(spent * (1 / self._share - 1))
            began = time.thread_time()
