"""Logging of nodes: Python loggers through the node's, and repeated warnings once a minute."""

import logging
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from rclpy.node import Node

PACKAGE_LOGGER = "symbid_ros"
PERIOD = 60.0  # s between two equal messages
MOST_KEPT = 1000  # messages remembered
# Matches free-standing numbers. Digits inside names of topics, files and joints stay, because
# they distinguish messages.
NUMBER = re.compile(r"(?<![\w/])[-+]?\d[\d.]*(?:e[-+]?\d+)?")


class NodeLogHandler(logging.Handler):
    """Forwards log records to a node's logger, whose level filters them.

    Parameters
    ----------
    node : Node
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._logger = node.get_logger()
        self.addFilter(OncePerMinute())

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record's message with its severity."""
        message = self.format(record)
        # One call per severity: rclpy allows a call site one severity only.
        if record.levelno >= logging.CRITICAL:
            self._logger.fatal(message)
        elif record.levelno >= logging.ERROR:
            self._logger.error(message)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(message)
        elif record.levelno >= logging.INFO:
            self._logger.info(message)
        else:
            self._logger.debug(message)


@contextmanager
def forward_python_logs(node: Node) -> Iterator[None]:
    """Forward all Python loggers of the process to a node's logger."""
    handler = NodeLogHandler(node)
    root, package = logging.getLogger(), logging.getLogger(PACKAGE_LOGGER)
    before = package.level
    root.addHandler(handler)
    # The node's level may change at run time, so it alone filters the package's messages.
    package.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        package.setLevel(before)
        root.removeHandler(handler)


class OncePerMinute(logging.Filter):
    """Passes each message at most once a minute, ignoring the numbers in it.

    It belongs on a handler: a filter on a logger does not see records of child loggers.
    """

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[tuple[str, str], float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        key, now = (record.name, NUMBER.sub("#", record.getMessage())), time.monotonic()
        if now - self._passed.get(key, float("-inf")) < PERIOD:
            return False
        if len(self._passed) >= MOST_KEPT:
            self._passed = {one: at for one, at in self._passed.items() if now - at < PERIOD}
        self._passed[key] = now
        return True


@dataclass
class FaultReporter:
    """Logs a fault when it appears, every minute while it lasts, and when it ends.

    Attributes
    ----------
    node : Node
        Node whose logger is used: the console and ``/rosout``.
    """

    node: Node
    _reported: dict[str, float] = field(default_factory=dict)

    def update(self, faults: Mapping[str, str]) -> None:
        """Report new, lasting and ended faults.

        Parameters
        ----------
        faults : mapping of str to str
            Current messages by subject. The numbers in a message may change from one update to
            the next; the key stays the same.
        """
        now, logger = time.monotonic(), self.node.get_logger()
        for key in [key for key in self._reported if key not in faults]:
            del self._reported[key]
            logger.info(f"{key}: resolved")
        for key, message in faults.items():
            if now - self._reported.get(key, float("-inf")) >= PERIOD:
                self._reported[key] = now
                logger.warning(message)
