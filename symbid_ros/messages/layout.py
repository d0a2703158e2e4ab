"""Byte layouts of serialised messages, which turn many messages into arrays at once.

CDR (OMG DDS-RTPS 2.5, section 10; XCDR version 1) writes a message's fields one after the other,
each aligned to its own size, after a 4-byte encapsulation header. Messages with equal strings and
sequence lengths therefore have all numbers at the same offsets. A NumPy record type with these
offsets reads and writes any number of such messages. rosbags, which supplies the definitions,
deserialises one message at a time and is too slow for whole logs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import ros2_jazzy

from symbid_ros.arrays import BoolArray, IntArray
from symbid_ros.errors import BagError

ByteArray = NDArray[np.uint8]
Records = NDArray[np.void]
Columns = dict[str, NDArray[Any]]

CDR = "cdr"  # name of the encoding in bags
ENCAPSULATION = 4
MAX_TRAILING = 32  # Fast CDR pads after the last field and, more than once, after empty sequences
NUMBERS = {
    "bool": "u1",
    "byte": "u1",
    "octet": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}


@cache
def typestore() -> Typestore:
    """Return the message definitions of ROS 2 Jazzy; this needs no ROS installation."""
    return Typestore(ros2_jazzy)


@dataclass(frozen=True)
class Layout:
    """Bytes that messages of one shape have in common, and the offsets of their numbers.

    Attributes
    ----------
    msgtype : str
        For example ``sensor_msgs/msg/Imu``.
    template : bytes
        One such message, serialised in little-endian order with its encapsulation header.
    dtype : numpy record type of ``len(template)`` bytes
        One field for each number or array of numbers, named by its path
        (``header.stamp.sec``, ``points.0.positions``). A message whose fields have one number type
        (Vector3, Quaternion, Point) is one field with the components in message order.
    text : dict of str to tuple of str
        Strings by path; a single string is a tuple of one.
    constant : (len(template),) bool
        True for bytes that belong neither to a number nor to padding.
    """

    msgtype: str
    template: bytes
    dtype: np.dtype[np.void]
    text: dict[str, tuple[str, ...]]
    constant: BoolArray

    @classmethod
    def of(cls, message: object, msgtype: str) -> "Layout":
        """Return the layout of a message object of rosbags."""
        template = bytes(typestore().serialize_cdr(message, msgtype, little_endian=True))
        builder = _LayoutBuilder()
        builder.message(message, msgtype, "")
        constant = np.zeros(len(template), dtype=bool)
        constant[:2] = True
        for start, stop in builder.fixed:
            constant[start:stop] = True
        dtype = np.dtype(
            {
                "names": [name for name, _, _ in builder.numbers],
                "formats": [form for _, form, _ in builder.numbers],
                "offsets": [offset for _, _, offset in builder.numbers],
                "itemsize": len(template),
            }
        )
        return cls(msgtype, template, dtype, builder.text, constant)

    @cached_property
    def _fixed(self) -> tuple[IntArray, NDArray[Any], NDArray[Any]]:
        """Return offsets, mask and content (W,) of the words that hold constant bytes.

        Words have four bytes if the length is a multiple of four: comparing these is faster.
        """
        word = np.dtype(np.uint8 if len(self.template) % 4 else np.uint32)
        mask = np.where(self.constant, 0xFF, 0).astype(np.uint8).view(word)
        places = np.flatnonzero(mask)
        return places, mask[places], (np.frombuffer(self.template, dtype=word) & mask)[places]

    def records(self, count: int) -> Records:
        """Return ``count`` copies of the template as writable records."""
        block = np.empty(count, dtype=self.dtype)
        block.view(f"V{len(self.template)}")[:] = np.void(self.template)
        return block

    def columns(self, records: Records) -> Columns:
        """Return writable views (N, ...) of the records' fields by path."""
        return {path: records[path] for path in self.dtype.names or ()}

    @cached_property
    def _packed(self) -> np.dtype[np.void]:
        return np.dtype(
            [
                (path, form.base, (1,)) if path.endswith("_covariance") else (path, form)
                for path, (form, *_) in (self.dtype.fields or {}).items()
            ]
        )

    def packed(self, records: Records) -> Records:
        """Return the numbers of records (N,), without text and padding.

        Only the first element of a covariance is kept; -1 marks an absent field (REP-145).
        """
        numbers = np.empty(len(records), dtype=self._packed)
        for path, (form, *_) in (self._packed.fields or {}).items():
            values = records[path]
            numbers[path] = values[:, :1] if form.shape == (1,) and values.ndim == 2 else values
        return numbers

    def matches(self, rows: ByteArray) -> BoolArray:
        """Return which rows (N, len(template)) of bytes have this layout."""
        places, mask, content = self._fixed
        words = rows.view(mask.dtype)[:, places]
        words &= mask
        verdict: BoolArray = (words == content).all(axis=1)
        return verdict

    def view(self, rows: ByteArray) -> Records:
        """View C-contiguous rows (N, len(template)) of bytes as (N,) records."""
        return rows.view(self.dtype)[:, 0]

    def matches_payload(self, payload: ByteArray) -> bool:
        """Return whether one message has this layout, apart from trailing padding."""
        size = len(self.template)
        if not 0 <= len(payload) - size <= MAX_TRAILING:
            return False
        return bool(self.matches(payload[None, :size])[0])


@dataclass
class _LayoutBuilder:
    """Collects the offsets of one message's fields in serialisation order."""

    offset: int = 0
    numbers: list[tuple[str, Any, int]] = field(default_factory=list)
    text: dict[str, tuple[str, ...]] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)

    def message(self, value: object, msgtype: str, path: str) -> None:
        fields = typestore().fielddefs[msgtype][1]
        kind = _equal_numbers(msgtype)
        if kind is not None:
            self._number(path, kind, (len(fields),))
            return
        for name, description in fields:
            self._field(getattr(value, name), description, f"{path}.{name}" if path else name)

    def _field(self, value: Any, description: Any, path: str) -> None:
        node, detail = description
        if node == Nodetype.BASE:
            if detail[0] == "string":
                self._strings(path, (value,))
            else:
                self._number(path, _format(detail[0], path), ())
        elif node == Nodetype.NAME:
            self.message(value, detail, path)
        else:
            if node == Nodetype.SEQUENCE:
                self._fix(4)
            self._elements(value, detail[0], path)

    def _elements(self, values: Any, description: Any, path: str) -> None:
        node, detail = description
        if node == Nodetype.BASE and detail[0] == "string":
            self._strings(path, tuple(values))
        elif node == Nodetype.BASE:
            self._number(path, _format(detail[0], path), (len(values),))
        else:
            for index, value in enumerate(values):
                self._field(value, description, f"{path}.{index}")

    def _align(self, size: int) -> None:
        self.offset += -self.offset % size

    def _fix(self, size: int) -> None:
        """Add a 32-bit length and its constant bytes."""
        self._align(4)
        start = ENCAPSULATION + self.offset
        self.fixed.append((start, start + size))
        self.offset += size

    def _strings(self, path: str, values: tuple[str, ...]) -> None:
        self.text[path] = values
        for value in values:
            self._fix(4 + len(value.encode()) + 1)

    def _number(self, path: str, form: str, shape: tuple[int, ...]) -> None:
        size = np.dtype(form).itemsize
        count = shape[0] if shape else 1
        if count:  # an empty sequence has no padding after its length
            self._align(size)
        self.numbers.append((path, (form, shape), ENCAPSULATION + self.offset))
        self.offset += count * size


def gather_rows(data: ByteArray, starts: IntArray, size: int) -> ByteArray:
    """Return the ``size`` bytes (N, size) that begin at each start (N,), all within the data.

    Overlapping views are ten times faster than an index for each byte.
    """
    if not len(starts):
        return np.empty((0, size), dtype=np.uint8)
    every = np.ndarray(len(data) - size + 1, dtype=f"V{size}", buffer=data, strides=(1,))
    rows: ByteArray = every[starts].view(np.uint8).reshape(-1, size)
    return rows


def _format(name: str, path: str) -> str:
    if name not in NUMBERS:
        raise BagError(
            f"{path}: fields of type {name} cannot be read into arrays; leave the topic out", "E217"
        )
    return NUMBERS[name]


@cache
def _equal_numbers(msgtype: str) -> str | None:
    """Return the number format that all fields of a message have, if it is the same."""
    kinds = set(_primitive_kinds(msgtype))
    only = kinds.pop() if len(kinds) == 1 else None
    return NUMBERS.get(only) if only is not None else None


def _primitive_kinds(msgtype: str) -> Iterator[str | None]:
    fields = typestore().fielddefs[msgtype][1]
    for _, (node, detail) in fields:
        yield str(detail[0]) if node == Nodetype.BASE and len(fields) > 1 else None
