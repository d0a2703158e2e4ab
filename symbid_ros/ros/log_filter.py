"""Warnings that a live stream would repeat every second."""

import logging
import re
import time

PERIOD = 60.0  # s
MOST_KEPT = 1000

# A number by itself: digits in names of topics, files and joints tell warnings apart.
FIGURE = re.compile(r"(?<![\w/])[-+]?\d[\d.]*(?:e[-+]?\d+)?")


class OncePerMinute(logging.Filter):
    """Passes a message at most once a minute, whatever the figures in it.

    Put it on a handler: a filter on a logger does not see the records of its child loggers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[tuple[str, str], float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record passes."""
        key, now = (record.name, FIGURE.sub("#", record.getMessage())), time.monotonic()
        if now - self._passed.get(key, float("-inf")) < PERIOD:
            return False
        if len(self._passed) >= MOST_KEPT:
            self._passed = {one: at for one, at in self._passed.items() if now - at < PERIOD}
        self._passed[key] = now
        return True
