"""Work that can be stopped and gone on with: every task leaves a file, and with it is done."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any

from symbid_ros.errors import StudyError


@dataclass(frozen=True)
class Task:
    """One step of a study.

    Attributes
    ----------
    output : Path
        The file or folder that the step leaves, whole or not at all.
    run : callable
        At a module's top level: it runs in another process.
    arguments : tuple
        What it is given.
    cost : float
        About how many seconds it takes.
    """

    output: Path
    run: Callable[..., None]
    arguments: tuple[Any, ...]
    cost: float


class Workers:
    """Processes that do tasks, in a ``with`` block that none of them survives.

    Parameters
    ----------
    count : int
        Number of processes.
    """

    def __init__(self, count: int) -> None:
        # Not forked: threads of this process, such as a progress bar's, would be left hanging.
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._pool.shutdown(wait=error is None, cancel_futures=True)
        if error is not None:
            # What they have begun is not kept, and nobody waits for it.
            for process in multiprocessing.active_children():
                process.terminate()

    def complete(self, tasks: Sequence[Task], done: Callable[[Task], None]) -> None:
        """Do what is not done yet, and call ``done`` with every task that is.

        Raises
        ------
        SymbidError
            The first that a task raised.
        StudyError
            When a process was killed.
        """
        running: dict[Future[None], Task] = {}
        for task in tasks:
            if task.output.exists():
                done(task)
            else:
                running[self._pool.submit(task.run, *task.arguments)] = task
        while running:
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                task = running.pop(future)
                try:
                    future.result()
                except BrokenProcessPool:
                    raise StudyError(
                        f"{task.output}: the process at work on it was killed, perhaps for want of "
                        "memory; start the study again to go on, with fewer --workers"
                    ) from None
                done(task)


def _begin() -> None:
    """Leave Ctrl-C to the process that waits, and BLAS to one thread; do not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"


def _end_with_parent() -> None:
    """End this process once its parent has been killed, which the pool would wait for for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
