"""Where every number of a serialised message lies, so that blocks of messages become arrays.

CDR (OMG DDS-RTPS 2.5, section 10; XCDR version 1) writes a message's fields one
after the other, each aligned to its own size behind a 4-byte encapsulation
header. Two messages whose strings and sequence lengths agree therefore have all
numbers at the same places: a NumPy record type with explicit offsets reads and
writes any number of them at once.
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

CDR = "cdr"  # its name as a message encoding
ENCAPSULATION = 4
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
    """Return ROS 2 Jazzy's message definitions; no ROS installation is asked."""
    return Typestore(ros2_jazzy)


@dataclass(frozen=True)
class Layout:
    """The bytes that all messages of one kind share and the places of their numbers.

    Attributes
    ----------
    msgtype : str
        For example ``sensor_msgs/msg/Imu``.
    template : bytes
        One such message, serialised little-endian with its encapsulation header.
    dtype : numpy record type of ``len(template)`` bytes
        One entry per number or array of numbers, named by its path
        (``header.stamp.sec``, ``points.0.positions``). A message of equal numbers
        (Vector3, Quaternion, Point) is one entry, components in message order.
    text : dict of str to tuple of str
        Strings by path; a single string is a tuple of one.
    constant : (len(template),) bool
        True where a byte is neither a number's nor padding.
    """

    msgtype: str
    template: bytes
    dtype: np.dtype[np.void]
    text: dict[str, tuple[str, ...]]
    constant: BoolArray

    @classmethod
    def of(cls, message: object, msgtype: str) -> "Layout":
        """Return the layout of one message object of rosbags' classes."""
        template = bytes(typestore().serialize_cdr(message, msgtype, little_endian=True))
        walk = _Walk()
        walk.message(message, msgtype, "")
        constant = np.zeros(len(template), dtype=bool)
        constant[:2] = True
        for start, stop in walk.fixed:
            constant[start:stop] = True
        dtype = np.dtype(
            {
                "names": [name for name, _, _ in walk.numbers],
                "formats": [form for _, form, _ in walk.numbers],
                "offsets": [offset for _, _, offset in walk.numbers],
                "itemsize": len(template),
            }
        )
        return cls(msgtype, template, dtype, walk.text, constant)

    @cached_property
    def _fixed(self) -> tuple[IntArray, NDArray[Any], NDArray[Any]]:
        """Return places, mask and content (W,) of the words that hold constant bytes.

        They are of four bytes where messages consist of such, as most do: that is faster.
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
    def _needed(self) -> np.dtype[np.void]:
        return np.dtype(
            [
                (path, form.base, (1,)) if path.endswith("_covariance") else (path, form)
                for path, (form, *_) in (self.dtype.fields or {}).items()
            ]
        )

    def condensed(self, records: Records) -> Records:
        """Return the numbers of records (N,) alone, without text and padding.

        Of a covariance the first element is kept, which tells whether its field is absent
        (REP-145).
        """
        numbers = np.empty(len(records), dtype=self._needed)
        for path, (form, *_) in (self._needed.fields or {}).items():
            values = records[path]
            numbers[path] = values[:, :1] if form.shape == (1,) and values.ndim == 2 else values
        return numbers

    def matches(self, rows: ByteArray) -> BoolArray:
        """Tell which rows (N, len(template)) of bytes follow this layout."""
        places, mask, content = self._fixed
        words = rows.view(mask.dtype)[:, places]
        words &= mask
        verdict: BoolArray = (words == content).all(axis=1)
        return verdict

    def view(self, rows: ByteArray) -> Records:
        """Return C-contiguous rows (N, len(template)) of bytes as (N,) records."""
        return rows.view(self.dtype)[:, 0]


@dataclass
class _Walk:
    """A walk over one message in serialisation order."""

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
        """Pass a 32-bit length and the bytes it announces."""
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
        if count:  # an empty sequence aligns nothing behind its length
            self._align(size)
        self.numbers.append((path, (form, shape), ENCAPSULATION + self.offset))
        self.offset += count * size


def gather_rows(data: ByteArray, starts: IntArray, size: int) -> ByteArray:
    """Return the ``size`` bytes (N, size) that begin at each start (N,), all inside the data.

    Taken as records of overlapping views: an index for every byte would take ten times as long.
    """
    if not len(starts):
        return np.empty((0, size), dtype=np.uint8)
    every = np.ndarray(len(data) - size + 1, dtype=f"V{size}", buffer=data, strides=(1,))
    rows: ByteArray = every[starts].view(np.uint8).reshape(-1, size)
    return rows


def _format(name: str, path: str) -> str:
    if name not in NUMBERS:
        raise BagError(f"{path}: fields of type {name} cannot be read into arrays")
    return NUMBERS[name]


@cache
def _equal_numbers(msgtype: str) -> str | None:
    """Return the number format all fields of a message share, if they do."""
    kinds = set(_primitive_kinds(msgtype))
    only = kinds.pop() if len(kinds) == 1 else None
    return NUMBERS.get(only) if only is not None else None


def _primitive_kinds(msgtype: str) -> Iterator[str | None]:
    fields = typestore().fielddefs[msgtype][1]
    for _, (node, detail) in fields:
        yield str(detail[0]) if node == Nodetype.BASE and len(fields) > 1 else None
