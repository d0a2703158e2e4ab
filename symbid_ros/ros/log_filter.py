"""Warnings that a live stream would repeat every second."""

import logging
import time

PERIOD = 60.0  # s


class OncePerMinute(logging.Filter):
    """Lets a warning through that has not been given in the last minute, whatever its figures."""

    def __init__(self) -> None:
        super().__init__()
        self._given: dict[tuple[str, str], float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Tell whether to let a record through."""
        key, now = (record.name, str(record.msg)), time.monotonic()
        if now - self._given.get(key, float("-inf")) < PERIOD:
            return False
        self._given[key] = now
        return True
