"""Warnings about faults that last: given when one appears, each minute it lasts, and at its end."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from rclpy.node import Node

PERIOD = 60.0  # s


@dataclass
class Notices:
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
