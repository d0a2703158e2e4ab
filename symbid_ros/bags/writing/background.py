"""Write a bag in background threads, so that the sources of messages never wait for the disk."""

import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Condition, Event, Thread
from typing import NamedTuple

from symbid_ros.bags.writing.writer import CHUNK_SIZE, BagWriter
from symbid_ros.messages.definitions import find_definition
from symbid_ros.messages.topics import OfferedQos


class QueuedMessage(NamedTuple):
    """A message to be written: number of its topic, times in nanoseconds, serialised message."""

    topic: int
    log_time: int
    publish_time: int
    payload: bytes


@dataclass(slots=True)
class _Entry:
    message: QueuedMessage | None  # None once dropped


@dataclass
class MessageQueue:
    """A bounded queue in which a large topic cannot displace small ones.

    When it is full, the topic with the most bytes loses its newest message. A single message is
    accepted regardless of its size.

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
        """Append a message, then drop messages while the queue exceeds its capacity."""
        entry = _Entry(message)
        self._entries.append(entry)
        self._by_topic[message.topic].append(entry)
        self._add(message, 1)
        while self.size > self.capacity and self._count > 1:
            self._drop()

    def take(self, size: int) -> list[QueuedMessage]:
        """Remove and return the oldest messages, at least ``size`` bytes if there are as many."""
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


@dataclass(frozen=True)
class WriterState:
    """Progress of writing a bag."""

    messages: int  # written to the operating system
    size: int  # bytes of the files
    queued: int  # bytes of messages that wait to be written
    dropped: dict[str, int]  # messages dropped by a full queue, by topic; only topics that lost any
    sync_age: float  # seconds since the last sync; older data are on the disk


class BackgroundWriter:
    """Queues messages for a thread that compresses and writes them; a second one syncs the disk.

    After a failed write no message is written any more; `failure` is its error.

    Parameters
    ----------
    bag : BagWriter
        Must not be used elsewhere until this writer is closed.
    flush_period : float
        Longest time, in seconds, until a message is written to the operating system. From then on
        it survives if the process is killed.
    sync_period : float
        Longest time, in seconds, until written data are synced to the disk. From then on they
        survive a power cut.
    capacity : int
        Bytes of messages that may wait. Beyond that, the topic with the most waiting bytes loses
        its newest messages, which are counted.
    """

    def __init__(
        self, bag: BagWriter, *, flush_period: float, sync_period: float, capacity: int
    ) -> None:
        self.failure: Exception | None = None
        self._bag = bag
        self._flush_period, self._sync_period = flush_period, sync_period
        self._names: list[str] = []
        self._received: list[int] = []
        self._latest = 0
        self._announced: list[tuple[str, str, Sequence[OfferedQos]]] = []
        self._queue = MessageQueue(capacity)
        self._messages = 0
        self._changed = Condition()
        self._ended = Event()
        self._is_closing = False
        self._synced = time.monotonic()
        self._threads = [
            Thread(target=self._guard, args=(work,), name=name, daemon=True)
            for name, work in (("bag writer", self._write), ("bag sync", self._sync))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def state(self) -> WriterState:
        """Progress of the bag."""
        age = time.monotonic() - self._synced
        with self._changed:
            dropped = {self._names[topic]: n for topic, n in self._queue.dropped.items()}
            return WriterState(self._messages, self._bag.size, self._queue.size, dropped, age)

    @property
    def received(self) -> int:
        """Number of messages passed to `put`."""
        return sum(self._received)

    @property
    def lost(self) -> dict[str, int]:
        """Messages received that are not in the closed bag, by topic; only topics that lost any."""
        counts = self._bag.counts
        missing = {
            name: received - counts.get(name, 0)
            for name, received in zip(self._names, self._received, strict=True)
        }
        return {name: count for name, count in missing.items() if count}

    @property
    def latest(self) -> int:
        """Largest log time received, nanoseconds."""
        return self._latest

    def add_topic(self, name: str, msgtype: str, qos: Sequence[OfferedQos]) -> int:
        """Announce a topic and return its number.

        Raises
        ------
        BagError
            When the definition of its type is not found.
        """
        find_definition(msgtype)  # fails here, where the caller can still omit the topic
        with self._changed:
            self._announced.append((name, msgtype, qos))
            self._names.append(name)
            self._received.append(0)
            return len(self._names) - 1

    def put(self, messages: Sequence[QueuedMessage]) -> None:
        """Queue messages in order of arrival, without blocking."""
        with self._changed:
            for message in messages:
                self._received[message.topic] += 1
                self._latest = max(self._latest, message.log_time)
                self._queue.put(message)
            if self._queue.size >= CHUNK_SIZE:
                self._changed.notify()

    def close(self) -> None:
        """Write the queued messages and complete the bag.

        After a failure, the bag is completed with the messages written before it.

        Raises
        ------
        BagError
            When the bag cannot be completed.
        """
        self._end()
        if self.failure is None:
            self._guard(self._bag.close)
        if self.failure is not None:
            self._bag.close_after_failure()

    def discard(self) -> None:
        """Remove the bag."""
        self._end()
        self._bag.discard()

    def _end(self) -> None:
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as failure:
            # The first failure is the cause; one in the other thread is its consequence.
            self.failure = self.failure or failure

    def _write(self) -> None:
        channels: list[int] = []
        flush_due = time.monotonic() + self._flush_period
        is_done = False
        while not is_done and self.failure is None:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._is_closing or self._queue.size >= CHUNK_SIZE,
                    max(0.0, flush_due - time.monotonic()),
                )
                # Take few messages at a time: only queued messages can be dropped.
                messages = self._queue.take(CHUNK_SIZE)
                announced, self._announced = self._announced, []
                is_done = self._is_closing and not messages
            channels += [self._bag.add_topic(*topic) for topic in announced]
            for message in messages:
                self._bag.write(
                    channels[message.topic], message.log_time, message.payload, message.publish_time
                )
            self._messages += len(messages)
            if is_done or time.monotonic() >= flush_due:
                self._bag.flush()
                flush_due = time.monotonic() + self._flush_period

    def _sync(self) -> None:
        while not self._ended.wait(self._sync_period):
            began = time.monotonic()
            self._bag.sync()
            self._synced = began
