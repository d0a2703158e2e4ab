"""Builds the rows of complete blocks in a background thread."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event

from symbid_ros.identification.accumulator import BlockAccumulator, TimeSpan
from symbid_ros.signals.sampled_rows import RowBuilder, SampledRows
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.signals.weak_form import EquationRows


class BlockWorker:
    """A queue of blocks and the thread that processes them with a bounded share of a core.

    Building a block's rows in the caller's thread would delay reading of the topics.

    Parameters
    ----------
    build : RowBuilder
        Builds rows from sensor samples.
    windows : sequence of float
        Window lengths, s.
    share : float
        Share of a core, above 0 and at most 1.
    accumulated : BlockAccumulator
        Data from before the first block.
    """

    def __init__(
        self,
        build: RowBuilder,
        windows: Sequence[float],
        share: float,
        accumulated: BlockAccumulator,
    ) -> None:
        self._build, self._windows, self._share = build, tuple(windows), share
        self._accumulated = accumulated
        self._skip_pauses = Event()
        self._pool = ThreadPoolExecutor(1, "blocks")
        self._queue: list[Future[BlockAccumulator]] = []

    def submit(self, block: TimeSpan) -> None:
        """Queue a block."""
        self._queue.append(self._pool.submit(self._add_rows, block))

    def take_finished(self) -> BlockAccumulator | None:
        """Return the accumulator if blocks were finished since the last call, else None."""
        accumulated = None
        while self._queue and self._queue[0].done():
            accumulated = self._queue.pop(0).result()
        return accumulated

    def finish(self) -> BlockAccumulator | None:
        """Process all queued blocks without pauses and return the accumulator."""
        self._skip_pauses.set()
        for future in self._queue:
            future.result()
        self._skip_pauses.clear()
        return self.take_finished()

    def restart(self, accumulated: BlockAccumulator) -> None:
        """Continue from another accumulator; the queue must be empty."""
        self._accumulated = accumulated

    def close(self) -> None:
        """Discard queued blocks and stop the thread."""
        self._skip_pauses.set()
        self._pool.shutdown(cancel_futures=True)

    def _add_rows(self, block: TimeSpan) -> BlockAccumulator:
        build = self._build
        if not (isinstance(build, EquationRows) and build.skips_samples):
            build = self._build_paced
        rows = self._accumulated.rows(block, build, self._windows)
        # The only thread of the pool writes it, one block after the other.
        self._accumulated = self._accumulated.with_block(rows)
        return self._accumulated

    def _build_paced(self, samples: SensorSamples) -> Iterator[SampledRows]:
        start = time.thread_time()
        for part in self._build(samples):
            yield part
            spent = time.thread_time() - start
            self._skip_pauses.wait(spent * (1 / self._share - 1))
            start = time.thread_time()
