"""A bounded queue of messages in which a large topic cannot crowd out the small ones."""

from collections import defaultdict, deque
from dataclasses import dataclass, field
from typing import NamedTuple


class QueuedMessage(NamedTuple):
    """A message on its way into a bag: topic's number, times in nanoseconds, bytes."""

    topic: int
    log_time: int
    publish_time: int
    payload: bytes


@dataclass(slots=True)
class _Entry:
    message: QueuedMessage | None  # None once dropped


@dataclass
class MessageQueue:
    """First in, first out; when it is full, the topic with the most bytes loses its newest message.

    One message is accepted whatever its size.

    Attributes
    ----------
    capacity : int
        Bytes of payload.
    size : int
        Bytes of payload in the queue.
    dropped : dict of int to int
        Number of messages dropped, by topic.
    """

    capacity: int
    size: int = 0
    dropped: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    _entries: deque[_Entry] = field(default_factory=deque)
    _by_topic: dict[int, deque[_Entry]] = field(default_factory=lambda: defaultdict(deque))
    _sizes: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    _count: int = 0

    def put(self, message: QueuedMessage) -> None:
        """Append a message and drop others, or this one, while the queue is too full."""
        entry = _Entry(message)
        self._entries.append(entry)
        self._by_topic[message.topic].append(entry)
        self._add(message, 1)
        while self.size > self.capacity and self._count > 1:
            self._drop()

    def take(self, size: int) -> list[QueuedMessage]:
        """Remove and return the oldest messages, of ``size`` bytes together or slightly more."""
        taken = []
        while self._entries and size > 0:
            message = self._entries.popleft().message
            if message is not None:
                self._by_topic[message.topic].popleft()
                self._add(message, -1)
                size -= len(message.payload)
                taken.append(message)
        return taken

    def _drop(self) -> None:
        largest = max(self._sizes, key=self._sizes.__getitem__)
        entry = self._by_topic[largest].pop()
        assert entry.message is not None
        self._add(entry.message, -1)
        self.dropped[largest] += 1
        entry.message = None

    def _add(self, message: QueuedMessage, sign: int) -> None:
        size = sign * len(message.payload)
        self.size += size
        self._sizes[message.topic] += size
        self._count += sign
