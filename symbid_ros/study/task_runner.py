"""Tasks that run in processes and resume: a task whose output file exists is complete.

joblib.Parallel could replace the process pool of the standard library. It neither skips tasks whose
output exists nor ends its processes together with the study, so nothing would become shorter.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from symbid_ros.errors import StudyError
from symbid_ros.shutdown import deferred


@dataclass(frozen=True)
class Task:
    """One step of a study.

    Attributes
    ----------
    output : Path
        The file or folder that the step writes atomically.
    run : callable
        A function at the top level of a module, as another process calls it.
    arguments : tuple
        Its arguments.
    cost : float
        Approximate duration, s.
    """

    output: Path
    run: Callable[..., None]
    arguments: tuple[Any, ...]
    cost: float


@contextmanager
def worker_pool(count: int) -> Iterator[Executor]:
    """Start ``count`` processes that run tasks; all of them end with the ``with`` block."""
    # A forked process could hang on locks held by threads, such as a progress bar's.
    context = multiprocessing.get_context("spawn")
    pool = _WorkerPool(count, mp_context=context, initializer=_initialize_worker)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        # Outputs are written atomically, so unfinished tasks leave nothing behind.
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    pool.shutdown()


class _WorkerPool(ProcessPoolExecutor):
    """Starts processes that never receive Ctrl-C, which the parent handles."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        # A process starts when it is first needed, and inherits the mask: it would otherwise be
        # interrupted while it imports libraries.
        with deferred():
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                return super().submit(fn, *args, **kwargs)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_tasks(pool: Executor, tasks: Sequence[Task], on_done: Callable[[Task], None]) -> None:
    """Run the tasks whose output is missing, and call ``on_done`` for each task once done.

    Raises
    ------
    SymbidError
        The first error that a task raised.
    StudyError
        If a process was killed.
    """
    running = {}
    for task in tasks:
        if task.output.exists():
            on_done(task)
        else:
            running[pool.submit(task.run, *task.arguments)] = task
    for future in as_completed(running):
        task = running[future]
        try:
            future.result()
        except BrokenProcessPool:
            raise StudyError(
                f"{task.output}: its process was killed, perhaps for lack of memory; "
                "start the study again to resume it, with fewer --workers",
                "E706",
            ) from None
        on_done(task)


def _initialize_worker() -> None:
    """Limit BLAS to one thread, and follow the parent."""
    Thread(target=_exit_with_parent, daemon=True).start()
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"


def _exit_with_parent() -> None:
    """End this process if its parent was killed; otherwise it would wait for tasks forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
