"""Messages of Python's loggers through a node's own: console, ``/rosout`` and ``--log-level``."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node

from symbid_ros.ros.log_filter import OncePerMinute

PACKAGE_LOGGER = "symbid_ros"


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
def python_logs_of(node: Node) -> Iterator[None]:
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
