"""Reactions to SIGINT, SIGTERM and SIGHUP: an event for nodes, an exception for commands."""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread, current_thread, main_thread
from typing import NoReturn

SIGNALS = signal.SIGINT, signal.SIGTERM
SET_PARENT_DEATH_SIGNAL = 1  # Linux's prctl.h


def stop_on_signals() -> Event:
    """Return an event that SIGINT and SIGTERM set from now on; call it in the main thread.

    A separate thread sets the event. A signal handler interrupts the main thread, possibly
    while it waits for this event and holds its lock, which is not reentrant; setting the event
    there would deadlock. A node that waits every millisecond hung in about 1 % of all Ctrl-C.
    """
    stop = Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    for number in SIGNALS:
        # Python writes to the pipe only for signals that have a handler.
        signal.signal(number, lambda *_: None)

    def watch() -> None:
        while os.read(reading, 1)[0] not in SIGNALS:
            pass
        stop.set()

    Thread(target=watch, name="signals", daemon=True).start()
    return stop


@contextmanager
def interruptible(stop: Event) -> Iterator[None]:
    """Let a signal end the process during work that cannot check ``stop``.

    A signal raises SystemExit in the block, with the shell's status for the signal, so that
    ``finally`` clauses run. Use it in the main thread, around work that leaves nothing incomplete.

    Parameters
    ----------
    stop : Event
        From :func:`stop_on_signals`; the block is not entered if it is set.
    """
    if stop.is_set():
        unwind(signal.SIGINT, None)
    before = {number: signal.signal(number, unwind) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def deferred() -> Iterator[None]:
    """Handle signals that arrive during the block at its end.

    Use it around steps that an exception must not separate, such as the start of a process and the
    assignment of its handle.
    """
    arrived: list[int] = []
    # Only the main thread is interrupted by signals; one that is ignored stays ignored.
    is_main = current_thread() is main_thread()
    before = {number: signal.getsignal(number) for number in (*SIGNALS, signal.SIGHUP) if is_main}
    before = {number: handler for number, handler in before.items() if callable(handler)}
    for number in before:
        signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for one in arrived:
            signal.raise_signal(one)


def exit_on_signals() -> None:
    """Make SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that cleanup code runs.

    An ignored signal, for example under ``nohup``, stays ignored.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, unwind)


def interrupt_on_sigterm() -> None:
    """Make SIGTERM raise KeyboardInterrupt, as Ctrl-C does; an ignored signal stays ignored."""
    if signal.getsignal(signal.SIGTERM) != signal.SIG_IGN:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def end_with_parent(parent: int) -> None:
    """Let SIGINT end this process when its parent has been killed; only Linux can do so.

    Call it before threads start. ``parent`` is the process id, in case the parent died meanwhile.
    """
    with suppress(AttributeError, OSError):  # of other systems' C libraries
        ctypes.CDLL(None).prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGINT)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGINT)


def unwind(number: int, _: object) -> NoReturn:
    """Handle a signal: end the process with the status that shells give it."""
    signal.signal(number, signal.SIG_IGN)  # a second signal would interrupt the cleanup
    sys.exit(128 + number)
