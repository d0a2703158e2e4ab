"""Connection to the scheduler of a Dask cluster: tasks, their progress, and their errors.

Dask is imported when it is needed, so that one machine needs no Dask.
"""

import asyncio
import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symbid_ros.cluster.log_tasks import installed_version, sees_file
from symbid_ros.errors import OptionError, StudyError, SymbidError
from symbid_ros.package_paths import PACKAGE, package_version
from symbid_ros.progress import report

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECTING_TIME = 10.0  # s to wait for the scheduler, and for its first worker
CHECK_PERIOD = 10.0  # s between checks whether there is still a worker while tasks wait
SCHEDULER_LOST = "scheduler-connection-lost"  # Dask's reason for the cancellation of all tasks

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Cluster:
    """A connected cluster.

    Attributes
    ----------
    client : distributed.Client
    address : str
        Of the scheduler, as the user gave it.
    """

    client: "Client"
    address: str

    @property
    def dashboard(self) -> str:
        """Address of the page on which Dask shows its tasks."""
        return str(self.client.dashboard_link)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """Start a task; arguments may be results of other tasks."""
        # Equal calls are other calls: a bag may have changed in between.
        return self.client.submit(function, *arguments, pure=False)

    def results(self, tasks: Sequence["Future[Any]"], step: str) -> list[Any]:
        """Wait for tasks, report their progress as ``step``, and return their results in order."""
        for done, task in enumerate(self._as_completed(tasks)):
            if task.status != "finished":
                task.result()  # raises the task's error
            report(step, (done + 1) / len(tasks))
        return [task.result() for task in tasks]

    def _as_completed(self, tasks: Sequence["Future[Any]"]) -> Iterator["Future[Any]"]:
        """Yield tasks as they end, and warn if there is no worker left for them."""
        from distributed import as_completed  # noqa: PLC0415 - an optional library

        left, has_workers, loop = set(tasks), True, self.client.loop
        while left:
            try:
                for task in as_completed(left, loop, raise_errors=False, timeout=CHECK_PERIOD):
                    left.discard(task)
                    yield task
            except TimeoutError:
                had_workers, has_workers = has_workers, bool(self.client.nthreads())
                if had_workers and not has_workers:
                    logger.warning(
                        "`dask` %s: the cluster has no worker any more, so its tasks wait; start "
                        "workers by `dask worker %s`, or end this command with Ctrl-C",
                        self.address,
                        self.address,
                    )

    def reduced(
        self, function: Callable[[Any, Any], Any], tasks: Sequence["Future[Any]"]
    ) -> "Future[Any]":
        """Combine results in pairs of neighbours, level by level, on the workers."""
        level = list(tasks)
        while len(level) > 1:
            pairs = zip(level[::2], level[1::2], strict=False)
            odd = level[-1:] if len(level) % 2 else []
            level = [self.submit(function, one, two) for one, two in pairs] + odd
        return level[0]

    def executor_of(self, folder: Path) -> Executor:
        """Return an executor whose tasks write files below ``folder``.

        Raises
        ------
        StudyError
            When a worker does not see the file ``folder``, which must be on a shared file system.
        """
        for worker, is_seen in _run_on_all(self, sees_file, str(folder)).items():
            if is_seen is not True:
                raise StudyError(
                    f"{folder}: the worker at {worker} does not see it; choose a folder on a file "
                    "system that all workers share",
                    "E957",
                )
        executor: Executor = self.client.get_executor(pure=False)
        return executor


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Connect to a Dask scheduler; unfinished tasks are cancelled at the end of the block.

    Errors of the cluster become errors of this package, in one line.

    Raises
    ------
    SymbidError
        When Dask is not installed, nothing answers at the address, there is no worker, a worker has
        another version of this package, workers died again and again, or the scheduler ended.
    """
    try:
        import distributed  # noqa: PLC0415 - an optional library
    except ModuleNotFoundError:
        raise SymbidError(
            f"`dask` needs Dask, which is not installed; run pip install '{PACKAGE}[dask]'", "E950"
        ) from None
    try:
        # A client whose address is invalid waits in vain when it is deleted.
        distributed.comm.resolve_address(address)
        with _dask_log_hidden():
            asyncio.run(_check_handshake(address))
            client = distributed.Client(address, timeout=CONNECTING_TIME, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OptionError(
            f"`dask` {address}: no scheduler answers ({reason}); start one by `dask scheduler`, "
            "and give the address that it prints",
            "E951",
        ) from None
    lost = CancelledError, distributed.comm.CommClosedError, distributed.client.ClosedClientError
    with _dask_log_hidden(), client:
        try:
            cluster = Cluster(client, address)
            _check_workers(cluster)
            yield cluster
        except distributed.scheduler.KilledWorker as error:
            raise SymbidError(
                f"`dask` {address}: {error.allowed_failures + 1} workers died while they ran one "
                "task, perhaps for lack of memory; give each worker more, and one thread "
                "(`--nthreads 1`)",
                "E953",
            ) from None
        except distributed.client.FutureCancelledError as error:
            if error.reason == SCHEDULER_LOST or client.status != "running":
                raise _scheduler_lost(address) from None
            reason = " ".join(str(error).split())
            raise SymbidError(
                f"`dask` {address}: the cluster dropped a task ({reason}); start again", "E953"
            ) from None
        except lost:
            # Tasks of an executor, and calls and new tasks after the connection was lost.
            raise _scheduler_lost(address) from None


def _scheduler_lost(address: str) -> SymbidError:
    return SymbidError(
        f"`dask` {address}: the scheduler ended, or the connection to it broke; start "
        "`dask scheduler` and its workers, and repeat the command",
        "E953",
    )


async def _check_handshake(address: str) -> None:
    """Raise an error if a server accepts a connection but does not answer as a scheduler.

    A client waits for it without end, for example for the web server of Dask's dashboard.
    """
    from distributed import comm  # noqa: PLC0415 - an optional library

    if comm.parse_address(address)[0] == "tcp":  # TLS has a handshake of its own
        connection = comm.connect(address, timeout=CONNECTING_TIME)
        try:
            opened = await asyncio.wait_for(connection, 1.2 * CONNECTING_TIME)
        except TimeoutError:
            raise OSError("another program listens there, perhaps Dask's dashboard") from None
        await opened.close()


@contextmanager
def _dask_log_hidden() -> Iterator[None]:
    """Hide Dask's log, such as tracebacks of lost connections; its errors are raised as well."""
    log = logging.getLogger("distributed")
    before = log.propagate, log.handlers
    log.propagate, log.handlers = False, [logging.NullHandler()]
    try:
        yield
    finally:
        log.propagate, log.handlers = before


def _run_on_all(cluster: Cluster, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
    """Call a function on each worker and return the results, or the errors, by address."""
    try:
        results: dict[str, Any] = cluster.client.run(function, *arguments, on_error="return")
    except OSError:
        raise _scheduler_lost(cluster.address) from None
    return results


def _check_workers(cluster: Cluster) -> None:
    """Raise an error unless there are workers, all with this version of the package."""
    client, address = cluster.client, cluster.address
    try:
        client.wait_for_workers(1, timeout=CONNECTING_TIME)
    except TimeoutError:
        raise SymbidError(
            f"`dask` {address}: the cluster has no worker; start some by `dask worker {address}`",
            "E952",
        ) from None
    own = package_version()
    # A worker without the package cannot even load the function, and returns the error instead.
    for worker, found in _run_on_all(cluster, installed_version).items():
        if found != own:
            has = f"has version {found}" if isinstance(found, str) else f"cannot load {PACKAGE}"
            raise SymbidError(
                f"`dask` {address}: the worker at {worker} {has}; install version {own} there",
                "E954",
            )
