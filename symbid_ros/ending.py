"""The wish to end, as an event that work can wait for."""

import os
import signal
from threading import Event, Thread

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
