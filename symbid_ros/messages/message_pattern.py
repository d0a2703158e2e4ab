"""The bytes of one layout, for single messages: comparing them costs a microsecond or two."""

import struct
from collections.abc import Iterable

import numpy as np

from symbid_ros.messages.decoder import MAX_TRAILING
from symbid_ros.messages.layout import Layout


class MessagePattern:
    """Recognises messages of a layout and reads some of their numbers, without NumPy.

    Parameters
    ----------
    layout : Layout
        Of messages that begin with a header.
    fields : iterable of str
        Paths of the arrays of float64 to read.
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
        """Tell whether a serialised message is of this layout."""
        if not 0 <= len(payload) - self._size <= MAX_TRAILING:
            return False
        return all(payload[place] == expected for place, expected in self._constant)

    def stamp(self, payload: bytes) -> tuple[int, int]:
        """Return seconds and nanoseconds of the header's stamp."""
        form, offset = self._stamp
        seconds, nanoseconds = form.unpack_from(payload, offset)
        return int(seconds), int(nanoseconds)

    def field_beyond(self, payload: bytes, largest: float) -> str:
        """Return the path of a field with a larger absolute value, empty if there is none.

        NaN is not larger.
        """
        for path, (form, offset) in self._fields.items():
            if any(map(largest.__lt__, map(abs, form.unpack_from(payload, offset)))):
                return path
        return ""
