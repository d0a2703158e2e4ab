"""Builds the rows of complete blocks in a background thread."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from threading import Event

import numpy as np

from symbid_ros.identification.calibration.extended_problem import NOISY_CHANNELS
from symbid_ros.identification.rows.accumulator import BlockAccumulator, TimeSpan
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.signals.sampled_rows import RowBuilder, SampledRows
from symbid_ros.signals.sensor_noise import MOTION, Channel
from symbid_ros.signals.sensor_samples import SensorSamples
from symbid_ros.signals.weak_form import EquationRows


def _noisy_channels(build: RowBuilder) -> tuple[Channel, ...]:
    return NOISY_CHANNELS if isinstance(build, CalibratingRows) else MOTION


def _with_block(
    accumulated: BlockAccumulator, block: TimeSpan, build: RowBuilder, windows: Sequence[float]
) -> BlockAccumulator:
    return accumulated.with_block(accumulated.rows(block, build, windows, _noisy_channels(build)))


@dataclass
class _Relinearization:
    """Rows of the kept blocks, built anew one block after the other."""

    build: RowBuilder
    accumulated: BlockAccumulator
    done: int = 0
    is_abandoned: bool = False


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
    most_kept : int
        Bytes of sensor data that are kept for :meth:`relinearize`. When there are more, the rows of
        all kept blocks become final.
    """

    def __init__(
        self,
        build: RowBuilder,
        windows: Sequence[float],
        share: float,
        accumulated: BlockAccumulator,
        most_kept: int = 0,
    ) -> None:
        self._build, self._windows, self._share = build, tuple(windows), share
        self._most_kept = most_kept
        self._skip_pauses = Event()
        self._pool = ThreadPoolExecutor(1, "blocks")
        self._queue: list[Future[None]] = []
        self._pending: _Relinearization | None = None
        self._keep_none(accumulated)

    def _keep_none(self, accumulated: BlockAccumulator) -> None:
        self._accumulated = self._final = accumulated
        self._kept: list[TimeSpan | None] = []  # None where the clock was restarted
        self._bytes = 0

    @property
    def build(self) -> RowBuilder:
        """What builds the rows of the next block."""
        return self._build

    @property
    def is_relinearizing(self) -> bool:
        """Whether kept blocks are being processed again."""
        return self._pending is not None

    def with_block(self, accumulated: BlockAccumulator, block: TimeSpan) -> BlockAccumulator:
        """Return an accumulator with the rows of one more block, built in the caller's thread."""
        return _with_block(accumulated, block, self._build, self._windows)

    def submit(self, block: TimeSpan) -> None:
        """Queue a block."""
        self._queue.append(self._pool.submit(self._add_rows, block))

    def relinearize(self, build: RowBuilder) -> None:
        """Begin to replace the rows of all kept blocks by those of another builder.

        New blocks are processed meanwhile, so that estimates stay up to date.
        """
        self._pending = _Relinearization(build, self._final)

    def take_finished(self) -> BlockAccumulator | None:
        """Return the accumulator if rows were finished since the last call, else None."""
        is_finished = False
        while self._queue and self._queue[0].done():
            self._queue.pop(0).result()
            is_finished = True
        if self._pending is not None and not self._queue:
            self._queue.append(self._pool.submit(self._relinearize_next, self._pending))
        return self._accumulated if is_finished else None

    def hurry(self, timeout: float) -> bool:
        """Process queued blocks without pauses for ``timeout`` s; return whether none is left."""
        self._skip_pauses.set()
        left = wait(self._queue, max(timeout, 0.0)).not_done
        self._skip_pauses.clear()
        return not left

    def finish(self, longest: float = np.inf) -> BlockAccumulator | None:
        """Process everything that is queued without pauses and return the accumulator.

        A relinearization with more than ``longest`` blocks left is abandoned.
        """
        if self._pending is not None and len(self._kept) - self._pending.done > longest:
            self._pending.is_abandoned = True
        self._skip_pauses.set()
        accumulated = None
        while self._queue or self._pending is not None:
            for future in self._queue:
                future.result()
            accumulated = self.take_finished() or accumulated
        self._skip_pauses.clear()
        return accumulated

    def restart(
        self,
        accumulated: BlockAccumulator,
        build: RowBuilder | None = None,
        windows: Sequence[float] | None = None,
    ) -> None:
        """Continue from another accumulator; the queue must be empty.

        Parameters
        ----------
        accumulated : BlockAccumulator
            Its rows are final.
        build : RowBuilder, optional
            Builds rows from now on.
        windows : sequence of float, optional
            Window lengths from now on, s.
        """
        self._keep_none(accumulated)
        self._build = build or self._build
        self._windows = self._windows if windows is None else tuple(windows)

    def restart_clock(self) -> BlockAccumulator:
        """Return the accumulator, to which blocks with any later stamps may be added.

        The queue must be empty.
        """
        self._accumulated = self._accumulated.with_new_clock()
        self._kept.append(None)
        return self._accumulated

    def close(self) -> None:
        """Discard queued blocks and stop the thread."""
        self._skip_pauses.set()
        self._pool.shutdown(cancel_futures=True)

    # Below, the only thread of the pool reads and writes what it accumulates, one task after the
    # other.

    def _add_rows(self, block: TimeSpan) -> None:
        build = self._build
        if not (isinstance(build, EquationRows) and build.skips_samples):
            build = self._build_paced
        channels = _noisy_channels(self._build)
        rows = self._accumulated.rows(block, build, self._windows, channels)
        self._accumulated = self._accumulated.with_block(rows)
        if not self._most_kept:
            return
        self._kept.append(block)
        self._bytes += sum(segment.nbytes for segment in block.segments)
        if self._bytes > self._most_kept and self._pending is None:
            self._keep_none(self._accumulated)

    def _relinearize_next(self, pending: _Relinearization) -> None:
        """Build the rows of one more kept block, or use the new rows if there is none."""
        if pending.is_abandoned:
            self._pending = None
            return
        if pending.done < len(self._kept):
            start = time.thread_time()
            accumulated, block = pending.accumulated, self._kept[pending.done]
            if block is None:
                pending.accumulated = accumulated.with_new_clock()
            else:
                pending.accumulated = _with_block(accumulated, block, pending.build, self._windows)
            pending.done += 1
            self._pause(time.thread_time() - start)
        if pending.done == len(self._kept):
            self._accumulated, self._build = pending.accumulated, pending.build
            self._pending = None

    def _build_paced(self, samples: SensorSamples) -> Iterator[SampledRows]:
        start = time.thread_time()
        for part in self._build(samples):
            yield part
            self._pause(time.thread_time() - start)
            start = time.thread_time()

    def _pause(self, spent: float) -> None:
        """Wait until ``spent`` seconds of processor time are the given share of a core."""
        self._skip_pauses.wait(spent * (1 / self._share - 1))
