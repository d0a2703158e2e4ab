"""Reactions to SIGINT, SIGTERM and SIGHUP: an event for nodes, an exception for commands."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import NoReturn

SIGNALS = signal.SIGINT, signal.SIGTERM


def stop_on_signals() -> Event:
    """Return an event that SIGINT and SIGTERM set from now on; call it in the main thread.

    A thread sets it. A handler runs between two instructions of the main thread, and if
    these lie within a wait for the very event, whose lock is not reentrant, setting it
    there never returns: about one Ctrl-C of a hundred would hang a node that waits for
    a deadline every millisecond.
    """
    stop = Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    for number in SIGNALS:
        # With no handler in Python nothing would be written to the pipe.
        signal.signal(number, lambda *_: None)

    def watch() -> None:
        while os.read(reading, 1)[0] not in SIGNALS:
            pass
        stop.set()

    Thread(target=watch, name="signals", daemon=True).start()
    return stop


@contextmanager
def interruptible(stop: Event) -> Iterator[None]:
    """Let a signal end the process while work is done that cannot look at ``stop``.

    The block is left by SystemExit with the shell's status for the signal, so that ``finally``
    clauses run. Call it in the main thread, and around work alone that leaves nothing half made.

    Parameters
    ----------
    stop : Event
        Of :func:`stop_on_signals`; the block is not entered once it is set.
    """
    if stop.is_set():
        unwind(signal.SIGINT, None)
    before = {number: signal.signal(number, unwind) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_on_signals() -> None:
    """Make SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that work can clean up.

    A signal that is ignored, as with ``nohup``, stays ignored.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, unwind)


def unwind(number: int, _: object) -> NoReturn:
    """Handle a signal: end the process with the status that shells give it."""
    signal.signal(number, signal.SIG_IGN)  # the next would interrupt the cleaning up
    sys.exit(128 + number)
