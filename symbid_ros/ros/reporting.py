"""What a node reports: log messages, lasting faults and its status on ``/diagnostics``."""

import logging
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from symbid_ros.ros.endpoints import reliable_qos

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PACKAGE_LOGGER = "symbid_ros"
REPEAT_PERIOD = 60.0  # s between two equal log messages
STATUS_PERIOD = 1.0  # s
MOST_KEPT = 1000  # messages remembered
# Matches free-standing numbers. Digits inside names of topics, files and joints stay, because
# they distinguish messages.
NUMBER = re.compile(r"(?<![\w/])[-+]?\d[\d.]*(?:e[-+]?\d+)?")


class NodeLogHandler(logging.Handler):
    """Forwards log records to a node's logger, whose level filters them."""

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


class _Collector(logging.Handler):
    """Appends the text of each record to a list."""

    def __init__(self, level: int, texts: list[str]) -> None:
        super().__init__(level)
        self._texts = texts

    def emit(self, record: logging.LogRecord) -> None:
        """Append a record's message."""
        self._texts.append(self.format(record))


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Yield a list that gets the warnings logged by Python loggers during the ``with`` block."""
    warnings: list[str] = []
    handler = _Collector(logging.WARNING, warnings)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield warnings
    finally:
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
        if now - self._passed.get(key, float("-inf")) < REPEAT_PERIOD:
            return False
        if len(self._passed) >= MOST_KEPT:
            self._passed = {one: at for one, at in self._passed.items() if now - at < REPEAT_PERIOD}
        self._passed[key] = now
        return True


@dataclass
class FaultReporter:
    """Logs a fault when it appears, every minute while it lasts, and when it ends."""

    node: Node
    _reported: dict[str, float] = field(default_factory=dict)

    def update(self, faults: Mapping[str, str]) -> None:
        """Report new, lasting and ended faults, given the current messages by subject."""
        now, logger = time.monotonic(), self.node.get_logger()
        for key in [key for key in self._reported if key not in faults]:
            del self._reported[key]
            logger.info(f"{key}: resolved")
        for key, message in faults.items():
            if now - self._reported.get(key, float("-inf")) >= REPEAT_PERIOD:
                self._reported[key] = now
                logger.warning(message)


@dataclass(frozen=True)
class NodeStatus:
    """The status of one part of a node, named ``<node>: <part>``.

    The level is ``OK``, ``WARN`` or ``ERROR``. The key-value pairs have a constant order.
    """

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class StatusPublisher:
    """Publishes the current statuses while the node's executor spins.

    The hardware ID is the name of the robot or bag.
    """

    def __init__(
        self, node: Node, current: Callable[[], Sequence[NodeStatus]], hardware_id: str
    ) -> None:
        self._node, self._current, self._hardware_id = node, current, hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", reliable_qos(10))
        # The status must be published even while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(STATUS_PERIOD, self._publish, clock=steady)

    def _publish(self) -> None:
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=status.level,
                hardware_id=self._hardware_id,
                name=f"{name}: {status.part}",
                message=status.message,
                values=[
                    KeyValue(key=key, value=str(value)) for key, value in status.values.items()
                ],
            )
            for status in (*self._current(), *self._dropped_messages())
        ]
        self._publisher.publish(message)

    def _dropped_messages(self) -> Sequence[NodeStatus]:
        """Return a warning if the node's executor has dropped messages or requests."""
        dropped = getattr(self._node.executor, "dropped", {})
        if not dropped:
            return ()
        message = f"messages or requests dropped on {', '.join(sorted(dropped))}"
        return (NodeStatus("messages", WARN, message, dict(sorted(dropped.items()))),)
