"""Live topics as one recording of which the newest seconds are at hand."""

from dataclasses import dataclass, field, replace

from symbid_ros.errors import DataError
from symbid_ros.messages.sensor_streams import sensor_streams
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.online.buffer import TopicBuffer
from symbid_ros.signals.defects import Tally
from symbid_ros.signals.stamps import CLOCK_JUMP, seconds
from symbid_ros.signals.streams import Streams


@dataclass
class LiveStreams:
    """Messages of a robot's sensor topics on one clock, their stamps'.

    Where a clock jumps back, by more than messages overtake each other, a new time begins: what
    other topics still send of the old one is left out.

    Attributes
    ----------
    selected : SelectedTopics
        Which they are.
    source : str
        How messages to the user name them.
    worked_until : int or None
        End of the last block given out, ns: what comes before it is late.
    buffers : dict of Topic to TopicBuffer
        What waits.
    """

    selected: SelectedTopics
    source: str
    worked_until: int | None = None
    buffers: dict[Topic, TopicBuffer] = field(init=False)
    _clock: int | None = None

    def __post_init__(self) -> None:
        self.buffers = {topic: TopicBuffer(topic) for topic in self.selected.all}

    @property
    def joints(self) -> TopicBuffer:
        """The joint states, whose stamps are the clock."""
        return self.buffers[self.selected.clock]

    def jumps_back(self, topic: Topic, stamp: int) -> bool:
        """Tell whether a message of that stamp, ns, begins a new time."""
        newest = self.buffers[topic].newest
        return stamp > 0 and newest is not None and stamp < newest - CLOCK_JUMP

    def restart(self) -> None:
        """Begin a new time, for which nothing is at hand yet."""
        self.worked_until = self._clock = None
        for buffer in self.buffers.values():
            buffer.clear()

    def add(self, topic: Topic, stamp: int, payload: bytes) -> None:
        """Take a message and its stamp, ns."""
        buffer = self.buffers[topic]
        buffer.received += 1
        # A simulation may begin at zero; a second zero shows that the driver sets no stamps.
        if stamp <= 0 and (buffer.newest is not None or buffer.unstamped):
            buffer.unstamped += 1
            if buffer.newest == 0:
                self._forget(buffer)
            return
        # The first of this topic: of this time, or left over from the one before?
        is_first = self._clock is not None and buffer.newest is None
        if is_first and abs(stamp - (self._clock or 0)) > CLOCK_JUMP:
            buffer.stale += 1
            buffer.newest_stale = stamp
            return
        if self.worked_until is not None and stamp < self.worked_until:
            buffer.late += 1
            return
        buffer.add(stamp, payload)
        self._clock = stamp if self._clock is None else max(self._clock, stamp)

    def _forget(self, buffer: TopicBuffer) -> None:
        """Drop what a topic has sent, and take the clock from the others."""
        buffer.clear()
        newest = [one.newest for one in self.buffers.values() if one.newest is not None]
        self._clock = max(newest, default=None)

    @property
    def clock(self) -> int | None:
        """Newest stamp of any topic, ns."""
        return self._clock

    @property
    def stale(self) -> int:
        """Messages left out because they belonged to no time that is worth waiting for."""
        return sum(buffer.stale for buffer in self.buffers.values())

    @property
    def complete_until(self) -> int | None:
        """Newest stamp (ns) that every topic has reached; None while one is silent."""
        newest = [buffer.newest for buffer in self.buffers.values()]
        known = [stamp for stamp in newest if stamp is not None]
        return min(known) if len(known) == len(newest) else None

    def between(self, start: int, stop: int) -> Streams:
        """Return the streams from ``start`` up to ``stop``, ns.

        Raises
        ------
        DataError
            When a topic has no message there, or an unusable one.
        """
        decoders = {}
        for topic, buffer in self.buffers.items():
            decoders[topic] = buffer.decoder(self.source, start, stop)
            if not decoders[topic].count:
                raise DataError(
                    f"{self.source}: {topic.name} was silent from {seconds(start)} to "
                    f"{seconds(stop)}; look after its driver"
                )
        tallies = {topic: Tally(self.source, topic.name) for topic in decoders}
        streams = sensor_streams(self.source, self.selected, decoders, tallies)
        streams = replace(streams, is_live=True)
        for topic, tally in tallies.items():
            tally.messages = decoders[topic].count
            tally.report()
        return streams

    def forget_before(self, stamp: int) -> None:
        """Let go of what is older than ``stamp``, ns."""
        for buffer in self.buffers.values():
            buffer.drop_before(stamp)
