"""Single messages of one topic, decoded as they arrive."""

import numpy as np

from symbid_ros.errors import DataError
from symbid_ros.messages.decoder import MAX_LAYOUTS, MAX_TRAILING, TopicDecoder
from symbid_ros.messages.layout import Layout, Records
from symbid_ros.messages.topics import Topic


class SingleMessages:
    """Decodes messages of one topic, one at a time.

    A message laid out like one of the recent ones costs a comparison of bytes.

    Parameters
    ----------
    topic : Topic
        Name and type.
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
        for place, layout in enumerate(self._layouts):
            size = len(layout.template)
            if 0 <= len(payload) - size <= MAX_TRAILING:
                row = np.frombuffer(payload, dtype=np.uint8, count=size)
                if layout.matches(row[None, :])[0]:
                    if place:
                        self._layouts.insert(0, self._layouts.pop(place))
                    return layout, row.view(layout.dtype)
        return self._learn(payload)

    def _learn(self, payload: bytes) -> tuple[Layout, Records]:
        known = self._layouts[: MAX_LAYOUTS - 1]
        decoder = TopicDecoder(self._topic.name, self._topic, layouts=known)
        try:
            decoder.add(np.frombuffer(payload, dtype=np.uint8), np.array([[0, len(payload)]]))
        except DataError as error:
            raise DataError(
                f"{self._topic.name}: a message is not a valid {self._topic.msgtype}; "
                "check its publisher"
            ) from error
        (piece,) = decoder.pieces
        # Big-endian messages have the layout of little-endian ones, but not their bytes.
        others = [layout for layout in known if layout is not piece.layout]
        self._layouts = [piece.layout, *others]
        return piece.layout, piece.records
