"""A log that a process of its own reads while this one uses it, which threads cannot do at once.

The process is a copy of this one (fork). It writes the segments to the file of their store, from
which this process maps them into its memory.
"""

import logging
import multiprocessing
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from queue import Queue

from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import BagError
from symbid_ros.identification.rows.segment_store import SegmentStore
from symbid_ros.progress import report, reported_to
from symbid_ros.shutdown import deferred
from symbid_ros.signals.segments import Segment

_is_allowed: ContextVar[bool] = ContextVar("reading_processes", default=False)


@contextmanager
def reading_processes() -> Iterator[None]:
    """Let logs be read by processes of their own while the context lasts.

    Only for programs whose threads are all their own, such as commands: where a thread of another
    library held a lock, the copy of the process would wait for ever.
    """
    token = _is_allowed.set(True)
    try:
        yield
    finally:
        _is_allowed.reset(token)


def can_read_in_process() -> bool:
    """Return whether a log may be read by a process of its own."""
    may_have_children = not multiprocessing.current_process().daemon
    return _is_allowed.get() and may_have_children and sys.platform == "linux"


def read_in_process(
    source: str, segments: Iterator[Segment], store: SegmentStore, checks: StreamChecks | None
) -> Iterator[Segment]:
    """Yield the segments of a log, and add them to a store; another process iterates over them.

    Parameters
    ----------
    source : str
        Name of the log, for messages.
    segments : iterator of Segment
    store : SegmentStore
        An empty one.
    checks : StreamChecks or None
        What the iterator checks; afterwards as if this process had iterated.

    Raises
    ------
    SymbidError
        When the iterator raises one, or the process is killed.
    """
    context = multiprocessing.get_context("fork")
    with suppress(OSError):  # the segments themselves are sent if they cannot be written
        store.open_file()
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(
        target=_send_all, args=(segments, store, checks, receiving, sending), daemon=True
    )
    try:
        with deferred(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads, from Python 3.12 on
            process.start()
        sending.close()
        while True:
            try:
                kind, content = receiving.recv()
            except (EOFError, OSError):  # the latter within a message
                raise BagError(
                    f"{source}: the process that reads it was killed, perhaps for lack of memory; "
                    "read it with `jobs` 1",
                    "E235",
                ) from None
            if kind == "segment":
                yield store.receive(content)
            elif kind == "progress":
                report(*content)
            elif kind == "log":
                logging.getLogger(content.name).handle(content)
            else:
                error, state = content
                if checks is not None:
                    vars(checks).update(state)
                if error is not None:
                    raise error
                return
    finally:
        if process.pid is not None:
            process.kill()
            process.join()
        receiving.close()


def _send_all(
    segments: Iterator[Segment],
    store: SegmentStore,
    checks: StreamChecks | None,
    receiving: Connection,
    sending: Connection,
) -> None:
    """Send the segments, what is logged and reported, and in the end an error and the checks."""
    receiving.close()  # so that sending fails once the other process is gone
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process ends this one
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    logging.root.handlers = [_Sender(sending)]
    error = None
    try:
        with reported_to(lambda *step: sending.send(("progress", step))):
            for segment in segments:
                sending.send(("segment", store.write(segment) or segment))
    except BrokenPipeError:
        return
    except Exception as raised:
        raised.add_note(traceback.format_exc())
        error = raised
    with suppress(BrokenPipeError):
        sending.send(("end", (error, {} if checks is None else vars(checks))))


class _Sender(QueueHandler):
    """Sends what is logged."""

    def __init__(self, sending: Connection) -> None:
        super().__init__(Queue())
        self._sending = sending

    def enqueue(self, record: logging.LogRecord) -> None:
        self._sending.send(("log", record))
