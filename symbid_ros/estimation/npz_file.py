"""Reads the arrays of an .npz that may be damaged or hostile, within limits of memory."""

import math
import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, BinaryIO

import numpy as np

from symbid_ros.errors import EstimateError
from symbid_ros.user_files import open_regular

MAX_ARRAYS = 10_000
MAX_BYTES = 2 << 30  # of all arrays, unpacked; a humanoid with 45 joints needs a quarter


def read_arrays(path: Path, kind: str, code: str = "E410") -> dict[str, np.ndarray]:
    """Return the arrays of an .npz that `symbid identify` writes under the name ``kind``.

    Raises
    ------
    EstimateError
        When it cannot be read or exceeds the limits. When it is not an archive of arrays, with
        ``code``.
    """
    try:
        with open_regular(path) as stream:
            _check_sizes(path, stream)
            stream.seek(0)
            # A single array is not a context manager, hence the TypeError below.
            with np.load(stream, allow_pickle=False) as stored:
                return dict(stored)
    except OSError as error:
        reason = error.strerror or "not a zip of arrays"
        raise EstimateError(f"{path}: cannot read it ({reason}); check the path", "E401") from None
    except (ValueError, TypeError, zipfile.BadZipFile, zlib.error, EOFError, AttributeError):
        # NumPy's own message advises loading the file as a pickle, so it is dropped.
        raise EstimateError(
            f"{path}: not {kind}; give the file that `symbid identify` wrote", code
        ) from None


def _check_sizes(path: Path, file: BinaryIO) -> None:
    """Reject arrays that exceed the limits or their own bytes, before memory is allocated."""
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        check_unpacked_size(path, sum(one.file_size for one in members), len(members))
        for member in members:
            with archive.open(member) as stream:
                shape, kind = _stated(stream)
                if math.prod(shape) * kind.itemsize != member.file_size - stream.tell():
                    raise ValueError("an array does not have the size in its header")


def check_unpacked_size(path: Path, size: int, arrays: int = 0) -> None:
    """Raise an error if the arrays of a file exceed the limits; ``size`` is in bytes."""
    if arrays > MAX_ARRAYS or size > MAX_BYTES:
        raise EstimateError(
            f"{path}: more than {MAX_ARRAYS} arrays or {MAX_BYTES >> 20} MiB unpacked, the limits; "
            "identify fewer logs at a time",
            "E411",
        )


def _stated(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type in an array's header."""
    npy = np.lib.format
    is_first = npy.read_magic(stream) == (1, 0)
    read = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
    try:
        shape, _, kind = read(stream)
    except (SyntaxError, TokenError, RecursionError, MemoryError):
        # NumPy passes on the parser's errors for a header that is not a Python literal.
        raise ValueError("an array has no valid header") from None
    return shape, kind
