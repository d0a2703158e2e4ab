"""Logging of nodes: Python loggers through the node's, and repeated warnings once a minute."""

import logging
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from rclpy.node import Node

PACKAGE_LOGGER = "symbid_ros"
MOST_KEPT = 1000
# A number by itself: digits in names of topics, files and joints tell warnings apart.
FIGURE = re.compile(r"(?<![\w/])[-+]?\d[\d.]*(?:e[-+]?\d+)?")
PERIOD = 60.0  # s


class NodeLogHandler(logging.Handler):
    """Hands records to a node's logger, whose level decides.

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
        # One call for each severity: rclpy ties a severity to the place of its call.
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
    """Let all Python loggers of the process log through a node."""
    handler = NodeLogHandler(node)
    root, package = logging.getLogger(), logging.getLogger(PACKAGE_LOGGER)
    before = package.level
    root.addHandler(handler)
    # The node's level may change while it runs, so that it alone decides about our own messages.
    package.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        package.setLevel(before)
        root.removeHandler(handler)


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


@dataclass
class FaultReporter:
    """Reports the current faults of a node on its console and on ``/rosout``.

    Attributes
    ----------
    node : Node
        Whose logger is used.
    """

    node: Node
    _reported: dict[str, float] = field(default_factory=dict)

    def update(self, faults: Mapping[str, str]) -> None:
        """Take what is wrong now.

        Parameters
        ----------
        faults : mapping of str to str
            Messages by what they are about. A message may change its figures from one update to
            the next; the key stays.
        """
        now, logger = time.monotonic(), self.node.get_logger()
        for key in [key for key in self._reported if key not in faults]:
            del self._reported[key]
            logger.info(f"{key}: in order now")
        for key, message in faults.items():
            if now - self._reported.get(key, float("-inf")) >= PERIOD:
                self._reported[key] = now
                logger.warning(message)
