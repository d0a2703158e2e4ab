"""Flags of contacts, which have no stamp: they hold from that of the last joint state before."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.errors import DataError
from symbid_ros.messages.layout import ENCAPSULATION
from symbid_ros.messages.topics import Topic
from symbid_ros.signals.streams import ContactFlags


@dataclass
class FlagHistory:
    """The changes of one contact's flag.

    Attributes
    ----------
    topic : Topic
        Of type std_msgs/Bool.
    frame_id : str
        The contact's frame.
    """

    topic: Topic
    frame_id: str
    _stamps: list[int] = field(default_factory=list)
    _flags: list[bool] = field(default_factory=list)

    def add(self, stamp: int, payload: bytes) -> None:
        """Add a serialised message that arrived after a joint state with this stamp, ns.

        Raises
        ------
        DataError
            When the message is too short.
        """
        if len(payload) <= ENCAPSULATION:
            raise DataError(
                f"{self.topic.name}: a message is not a valid {self.topic.msgtype}; check its "
                "publisher",
                "E216",
            )
        touches = payload[ENCAPSULATION] != 0
        if self._flags and (self._flags[-1] == touches or stamp < self._stamps[-1]):
            return
        if self._stamps and self._stamps[-1] == stamp:
            self._flags[-1] = touches
            return
        self._stamps.append(stamp)
        self._flags.append(touches)

    def clear(self) -> None:
        """Drop all flags, as after a jump of the clock."""
        self._stamps.clear()
        self._flags.clear()

    def drop_before(self, stamp: int) -> None:
        """Drop the flags that ended before ``stamp``, ns."""
        index = max(int(np.searchsorted(self._stamps, stamp, side="right")) - 1, 0)
        del self._stamps[:index], self._flags[:index]

    @property
    def flags(self) -> ContactFlags:
        """All flags so far."""
        return ContactFlags(
            self.topic.name,
            self.frame_id,
            np.array(self._stamps, dtype=np.int64),
            np.array(self._flags, dtype=bool),
        )
