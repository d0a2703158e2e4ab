"""Progress of long work, reported to a listener such as a progress bar; without one to nobody."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# Receives the name of the step, and the share of it that is done or None if that is unknown.
Listener = Callable[[str, float | None], None]

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report(step: str, share: float | None = None) -> None:
    """Report the step that runs, and the share of it that is done, from 0 to 1."""
    listener = _listener.get()
    if listener is not None:
        listener(step, share)


@contextmanager
def reported_to(listener: Listener) -> Iterator[None]:
    """Report progress to a listener while the context lasts."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
