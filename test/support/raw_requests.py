"""Requests of arbitrary bytes to services, which no client library can send.

The request types' serialisation functions in the middleware's type support are replaced in this
process while a context lasts.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy

LIBRARIES = Path(rclpy.__path__[0]).parents[2]
LARGEST = 1 << 16  # bytes
Serialize = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_void_p)
Size = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p)
LargestSize = ctypes.CFUNCTYPE(ctypes.c_size_t, ctypes.POINTER(ctypes.c_char))


class _TypeSupport(ctypes.Structure):
    _fields_ = (("identifier", ctypes.c_char_p), ("callbacks", ctypes.c_void_p))


class _Callbacks(ctypes.Structure):
    """The first members of message_type_support_callbacks_t (rosidl_typesupport_fastrtps_cpp)."""

    _fields_ = (
        ("package", ctypes.c_char_p),
        ("message", ctypes.c_char_p),
        ("serialize", Serialize),
        ("deserialize", ctypes.c_void_p),
        ("size", Size),
        ("largest_size", LargestSize),
    )


def _callbacks(package: str, kind: str, name: str) -> _Callbacks:
    library = ctypes.CDLL(str(LIBRARIES / f"lib{package}__rosidl_typesupport_fastrtps_c.so"))
    prefix = "rosidl_typesupport_fastrtps_c__get_message_type_support_handle"
    handle = getattr(library, f"{prefix}__{package}__{kind}__{name}")
    handle.restype = ctypes.POINTER(_TypeSupport)
    return ctypes.cast(handle().contents.callbacks, ctypes.POINTER(_Callbacks)).contents


@contextmanager
def raw_requests(kind: type[Any]) -> Iterator[list[int]]:
    """Yield a list: clients of a service type created meanwhile send its bytes as their request."""
    payload: list[int] = []
    write_byte = _callbacks("std_msgs", "msg", "UInt8").serialize

    def serialize(_: int, stream: int) -> bool:
        return all(write_byte(ctypes.byref(ctypes.c_uint8(byte)), stream) for byte in payload)

    def largest_size(is_bounded: Any) -> int:
        is_bounded[0] = b"\0"
        return LARGEST

    replacements = {
        "serialize": Serialize(serialize),
        "size": Size(lambda _: len(payload) + 16),
        "largest_size": LargestSize(largest_size),
    }
    callbacks = _callbacks(kind.__module__.split(".")[0], "srv", f"{kind.__name__}_Request")
    original = bytes(callbacks)
    for name, function in replacements.items():
        setattr(callbacks, name, function)
    try:
        yield payload
    finally:
        ctypes.memmove(ctypes.addressof(callbacks), original, len(original))
