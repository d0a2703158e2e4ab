"""How far a recording has come: a line in the terminal and a status on ``/diagnostics``."""

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from symbid_ros.bags.writing.background import WriterState
from symbid_ros.ros.health import ERROR, OK, WARN, Health

REFRESH = 0.5  # s
LATE_SYNC = 5.0  # s; a healthy disk answers within milliseconds


class RecordingProgress:
    """Watches a writer; shows one line in place on a terminal, elsewhere nothing.

    Parameters
    ----------
    bag : str
        What is being written.
    console : Console
        Where to.
    """

    def __init__(self, bag: str, console: Console) -> None:
        self._bag = bag
        self._live = (
            Live(console=console, auto_refresh=False, transient=True)
            if console.is_interactive
            else None
        )
        self._began = self._shown = time.monotonic()
        self._messages = 0
        self._rate = 0.0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, state: WriterState) -> None:
        """Bring the figures up to date, twice a second."""
        now = time.monotonic()
        if now - self._shown < REFRESH:
            return
        self._rate = (state.messages - self._messages) / (now - self._shown)
        self._shown, self._messages = now, state.messages
        if self._live is not None:
            self._live.update(self._line(state), refresh=True)

    def health(self, state: WriterState, failure: Exception | None) -> Health:
        """Return the status of the recording."""
        level, message = OK, "recording" if state.messages else "waiting for messages"
        if failure is not None:
            level, message = ERROR, str(failure)
        elif state.dropped:
            level, message = WARN, "messages dropped: the disk or the processor is too slow"
        elif state.sync_age > LATE_SYNC:
            level, message = WARN, "the disk does not keep up"
        values = {
            "bag": self._bag,
            "messages": state.messages,
            "bytes": state.size,
            "rate": f"{self._rate:.1f}",
            "queued": state.queued,
            "dropped": sum(state.dropped.values()),
            "sync_age": f"{state.sync_age:.2f}",
        } | {f"dropped {topic}": count for topic, count in state.dropped.items()}
        return Health("recording", level, message, values)

    def _line(self, state: WriterState) -> Text:
        # What matters most comes first: a narrow terminal shows no more.
        parts = [
            f"{self._shown - self._began:.0f} s",
            f"{state.size / 1e6:.1f} MB",
            f"{self._rate:.0f} messages/s",
            f"{state.messages} messages",
            self._bag,
        ]
        if state.dropped:
            parts.insert(0, f"{sum(state.dropped.values())} dropped")
        text = Text("recording  " + "  ".join(parts), no_wrap=True, overflow="ellipsis")
        if state.dropped:
            text.stylize("red")
        return text
