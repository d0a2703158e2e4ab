"""Payloads that no subscriber can read: truncated, oversized and random ones."""

import struct
from collections.abc import Iterator
from itertools import islice
from random import Random

HEAD = 4  # bytes of the encapsulation, the smallest message that the middleware sends
LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def malformed(valid: bytes, draw: Random) -> Iterator[bytes]:
    """Yield an endless sequence of payloads that are invalid for the type of a valid message.

    Parameters
    ----------
    valid : bytes
        A serialised message that ends with a number or with a string.
    draw : Random
    """
    while True:
        yield valid[: draw.randrange(HEAD, max(HEAD + 1, len(valid) - 8))]
        yield valid + draw.randbytes(draw.randrange(100, 100_000))
        yield LITTLE_ENDIAN + draw.randbytes(draw.randrange(60))
        yield draw.randbytes(HEAD + draw.randrange(200))
        # The first sequence or string claims a length of nearly 4 GB.
        yield valid[:12] + struct.pack("<I", 2**32 - draw.randrange(1, 9)) + valid[16:]


def some_malformed(valid: bytes, count: int) -> list[bytes]:
    """Return the same number of each kind, starting with the shortest and the empty message."""
    extremes = (LITTLE_ENDIAN, LITTLE_ENDIAN + b"\x00\x00\x00")
    return [*extremes, *islice(malformed(valid, Random(count)), count - len(extremes))]
