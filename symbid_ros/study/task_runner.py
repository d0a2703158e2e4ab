"""Tasks that run in processes and resume: a task whose output file exists is done.

joblib.Parallel would replace the process pool of the standard library, but not what is added to it
here: skipping tasks whose output exists, and ending the processes together with the study.
"""

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
        The file or folder that the step writes atomically.
    run : callable
        A function at a module's top level, as another process calls it.
    arguments : tuple
        Its arguments.
    cost : float
        Approximate duration, s.
    """

    output: Path
    run: Callable[..., None]
    arguments: tuple[Any, ...]
    cost: float


class WorkerPool:
    """Processes that run tasks; all of them end with the ``with`` block.

    Parameters
    ----------
    count : int
        Number of processes.
    """

    def __init__(self, count: int) -> None:
        # A forked process could hang on locks held by threads, such as a progress bar's.
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=_initialize_worker)

    def __enter__(self) -> "WorkerPool":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._pool.shutdown(wait=error is None, cancel_futures=True)
        if error is not None:
            # Outputs are written atomically, so unfinished tasks leave nothing behind.
            for process in multiprocessing.active_children():
                process.terminate()

    def run(self, tasks: Sequence[Task], on_done: Callable[[Task], None]) -> None:
        """Run the tasks whose output is missing, and call ``on_done`` for each task once done.

        Raises
        ------
        SymbidError
            The first error that a task raised.
        StudyError
            If a process was killed.
        """
        running: dict[Future[None], Task] = {}
        for task in tasks:
            if task.output.exists():
                on_done(task)
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
                        f"{task.output}: its process was killed, perhaps for lack of memory; "
                        "start the study again to resume it, with fewer --workers",
                        "E706",
                    ) from None
                on_done(task)


def _initialize_worker() -> None:
    """Ignore Ctrl-C, which the parent handles, limit BLAS to one thread, and follow the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_exit_with_parent, daemon=True).start()
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"


def _exit_with_parent() -> None:
    """End this process if its parent was killed; the pool would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
