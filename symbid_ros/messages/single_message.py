"""Messages handled one at a time as they arrive: decode, recognise, count gaps."""

import struct
from array import array
from collections.abc import Iterable

import numpy as np

from symbid_ros.errors import DataError
from symbid_ros.messages.decoder import MAX_LAYOUTS, TopicDecoder
from symbid_ros.messages.layout import MAX_TRAILING, Layout, Records
from symbid_ros.messages.topics import Topic
from symbid_ros.signals.defects import Gaps, find_gaps


class SingleMessageDecoder:
    """Decodes messages of one topic, one at a time.

    A message with the layout of a recent one costs one comparison of bytes.

    Parameters
    ----------
    topic : Topic
    """

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._layouts: list[Layout] = []

    def decode(self, payload: bytes) -> tuple[Layout, Records]:
        """Return the layout of a serialised message and its numbers, a record array of one.

        Raises
        ------
        DataError
            When the bytes are not a message of the topic's type.
        """
        row = np.frombuffer(payload, dtype=np.uint8)
        for place, layout in enumerate(self._layouts):
            if layout.matches_payload(row):
                if place:
                    self._layouts.insert(0, self._layouts.pop(place))
                return layout, row[: len(layout.template)].view(layout.dtype)
        return self._learn(payload)

    def _learn(self, payload: bytes) -> tuple[Layout, Records]:
        known = self._layouts[: MAX_LAYOUTS - 1]
        decoder = TopicDecoder(self._topic.name, self._topic, layouts=known)
        try:
            decoder.add(np.frombuffer(payload, dtype=np.uint8), np.array([[0, len(payload)]]))
        except DataError as error:
            raise DataError(
                f"{self._topic.name}: a message is not a valid {self._topic.msgtype}; "
                "check its publisher",
                "E216",
            ) from error
        (batch,) = decoder.batches
        # A big-endian message shares its layout with little-endian ones, but not its bytes.
        others = [layout for layout in known if layout is not batch.layout]
        self._layouts = [batch.layout, *others]
        return batch.layout, batch.records


class MessagePattern:
    """Recognises messages of one layout and reads some of their numbers in a microsecond or two.

    It does without NumPy, whose calls take longer than the comparison of one message.

    Parameters
    ----------
    layout : Layout
        Layout of messages that begin with a header.
    fields : iterable of str
        Paths of the float64 arrays to read.
    """

    def __init__(self, layout: Layout, fields: Iterable[str]) -> None:
        edges = np.flatnonzero(np.diff(layout.constant, prepend=False, append=False)).tolist()
        self._constant = tuple(
            (slice(start, stop), layout.template[start:stop])
            for start, stop in zip(edges[::2], edges[1::2], strict=True)
        )
        self._size = len(layout.template)
        places = dict(layout.dtype.fields or {})
        self._fields: dict[str, tuple[struct.Struct, int]] = {}
        for path in fields:
            form, offset = places[path][:2]
            count = form.itemsize // np.dtype(np.float64).itemsize
            self._fields[path] = struct.Struct(f"<{count}d"), offset
        self._stamp = struct.Struct("<iI"), places["header.stamp.sec"][1]

    def matches(self, payload: bytes) -> bool:
        """Return whether a serialised message has this layout."""
        if not 0 <= len(payload) - self._size <= MAX_TRAILING:
            return False
        # A generator would take twice as long.
        for place, expected in self._constant:  # noqa: SIM110
            if payload[place] != expected:
                return False
        return True

    def stamp(self, payload: bytes) -> tuple[int, int]:
        """Return seconds and nanoseconds of the header's stamp."""
        form, offset = self._stamp
        seconds, nanoseconds = form.unpack_from(payload, offset)
        return int(seconds), int(nanoseconds)

    def field_beyond(self, payload: bytes, largest: float) -> str:
        """Return the path of a field with a larger absolute value; NaN is not larger.

        The path is empty if there is no such field.
        """
        for path, (form, offset) in self._fields.items():
            values = form.unpack_from(payload, offset)
            # The extremes settle most messages. They are NaN only if the first value is.
            if values and max(values) <= largest and min(values) >= -largest:
                continue
            if any(map(largest.__lt__, map(abs, values))):
                return path
        return ""


BLOCK = 65536  # stamps


class GapCounter:
    """Counts gaps between the stamps of one topic, in memory of constant size."""

    def __init__(self) -> None:
        self._stamps = array("q")
        self._blocks: list[Gaps] = []

    def add(self, stamp: int) -> None:
        """Add the stamp of the next message, in nanoseconds."""
        self._stamps.append(stamp)
        if len(self._stamps) > BLOCK:
            self._blocks.append(find_gaps(np.array(self._stamps)))
            del self._stamps[:-1]  # where the first interval of the next block begins

    @property
    def gaps(self) -> Gaps:
        """Gaps so far; the period is the median over the blocks."""
        blocks = [*self._blocks, find_gaps(np.array(self._stamps, dtype=np.int64))]
        periods = [block.period for block in blocks if block.period]
        return Gaps(
            period=int(np.median(periods)) if periods else 0,
            gaps=sum(block.gaps for block in blocks),
            missing=sum(block.missing for block in blocks),
            longest=max(block.longest for block in blocks),
            disordered=sum(block.disordered for block in blocks),
        )
