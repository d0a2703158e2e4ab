"""A Dask cluster as a user starts it: a scheduler and workers as processes, on loopback."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

HOST = "127.0.0.1"


@dataclass(frozen=True)
class LocalCluster:
    address: str
    scheduler: subprocess.Popen
    workers: tuple[subprocess.Popen, ...]
    start_worker: Callable[[], subprocess.Popen]  # another one, which ends with the others


@contextmanager
def local_cluster(folder: Path, workers: int = 2) -> Iterator[LocalCluster]:
    """Start a scheduler and workers with one thread each; all end with the block."""
    with ExitStack() as stack:

        def start(*arguments: str) -> subprocess.Popen:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments, "--no-dashboard"],
                stderr=subprocess.PIPE,
                text=True,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
            stack.callback(process.stderr.close)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        scheduler = start("scheduler", "--host", HOST, "--port", "0")
        line = next(line for line in scheduler.stderr if "Scheduler at:" in line)
        address = line.split()[-1]
        own = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder))

        def start_worker() -> subprocess.Popen:
            return start("worker", address, *own)

        started = [start_worker() for _ in range(workers)]
        for worker in started:
            next(line for line in worker.stderr if "Registered to:" in line)
        yield LocalCluster(address, scheduler, tuple(started), start_worker)
