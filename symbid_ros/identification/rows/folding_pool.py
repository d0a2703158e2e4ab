"""Rows of blocks built and folded by several threads, with the same result as by one."""

import ctypes
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from itertools import islice
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

from symbid_ros.estimation.observations import Observations
from symbid_ros.signals.weak_form import WindowedRows

P = ParamSpec("P")
T = TypeVar("T")
Rows = tuple[WindowedRows, ...]

# Rows that are folded at once, at least: each fold copies the factors, and few rows take LAPACK
# longer per row. Many would take memory.
BATCH = 256
RELEASE_PERIOD = 16  # blocks after which freed memory is released
M_ARENA_MAX = -8  # glibc's malloc.h


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def read_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield the items of an iterator, of which a thread reads the next one meanwhile."""
    context = copy_context()  # in which progress is reported

    def following() -> list[T]:
        return context.run(lambda: list(islice(items, 1)))

    with ThreadPoolExecutor(1, "reading") as pool:
        ahead = pool.submit(following)
        while found := ahead.result():
            ahead = pool.submit(following)
            yield from found


class FoldingPool:
    """Builds the rows of blocks in any order, and folds those of each window length in order.

    Folding in order makes the result independent of the number of threads. NumPy, LAPACK and the
    compiled regressor release the interpreter lock, so threads run at the same time and share the
    log in memory. Use it as a context manager: leaving it discards waiting blocks, also after an
    error or Ctrl-C.

    Parameters
    ----------
    observations : mapping of float to Observations
        What to start from, by window length, s.
    jobs : int
        Number of threads; with one, all is done in the caller's thread.
    """

    def __init__(self, observations: Mapping[float, Observations], jobs: int) -> None:
        self._observations = dict(observations)
        self._jobs = jobs
        self._pool: Executor | None = None
        if jobs > 1:
            _share_memory_pools()
            self._pool = ThreadPoolExecutor(jobs, "rows")
        self._waiting: deque[tuple[Sequence[float], Future[Rows]]] = deque()
        self._batch: dict[float, list[WindowedRows]] = {window: [] for window in observations}
        self._folding: dict[float, Future[Observations]] = {}
        self._added = 0
        self._covered = {window: frozenset[int]() for window in observations}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def submit(
        self,
        windows: Sequence[float],
        build: Callable[P, Rows],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """Add a block whose rows ``build`` returns, for each of some window lengths.

        Errors of earlier blocks are raised here.
        """
        if self._pool is None:
            self._add(windows, build(*args, **kwargs))
            return
        self._waiting.append((windows, self._pool.submit(partial(build, *args, **kwargs))))
        while len(self._waiting) > self._jobs or (self._waiting and self._waiting[0][1].done()):
            self._take_oldest()

    def cover(self, windows: Sequence[float], seconds: frozenset[int]) -> None:
        """Mark the observations of some window lengths as covering seconds of a log."""
        for window in windows:
            self._covered[window] |= seconds

    def finish(self) -> tuple[Observations, ...]:
        """Return the observations with all blocks folded."""
        while self._waiting:
            self._take_oldest()
        for window in self._batch:
            self._fold(window)
        found = tuple(
            self._current(window).covering(seconds) for window, seconds in self._covered.items()
        )
        _release_free_memory()
        return found

    def _take_oldest(self) -> None:
        windows, rows = self._waiting.popleft()
        self._add(windows, rows.result())

    def _add(self, windows: Sequence[float], rows: Rows) -> None:
        for window, part in zip(windows, rows, strict=True):
            self._batch[window].append(part)
            if sum(len(each.stamp) for each in self._batch[window]) >= BATCH:
                self._fold(window)
        self._added += 1
        # A single thread uses again what it has freed, sooner than the system would clear it.
        if self._pool is not None and self._added % RELEASE_PERIOD == 0:
            _release_free_memory()

    def _fold(self, window: float) -> None:
        """Fold the batch of one window length, after those before it."""
        batch, self._batch[window] = self._batch[window], []
        before = self._current(window)
        if self._pool is None:
            self._observations[window] = before.fold(batch)
        else:
            self._folding[window] = self._pool.submit(before.fold, batch)

    def _current(self, window: float) -> Observations:
        """Return the observations of a window length once its last batch is folded."""
        folding = self._folding.pop(window, None)
        if folding is not None:
            self._observations[window] = folding.result()
        return self._observations[window]


def _share_memory_pools() -> None:
    """Let all threads allocate from one pool of memory, where the C library can.

    By default glibc gives each thread a pool of its own, which keeps what the thread has freed.
    """
    _c_library_call("mallopt", M_ARENA_MAX, 1)


def _release_free_memory() -> None:
    """Return freed memory to the operating system, where the C library can."""
    _c_library_call("malloc_trim", 0)


def _c_library_call(name: str, *arguments: int) -> None:
    """Call a function of glibc; musl, macOS and Windows lack those used here."""
    with suppress(AttributeError, OSError, TypeError):
        getattr(ctypes.CDLL(None), name)(*arguments)
