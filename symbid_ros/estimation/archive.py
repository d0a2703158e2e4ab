"""information.npz: what a run knows, so that the next can go on from it."""

import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic import write_through
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.layout import RowLayout
from symbid_ros.estimation.observations import Observations

FORMAT = 2
MAX_ARRAYS = 10_000
MAX_BYTES = 512 << 20  # of all arrays, unpacked


def write_archive(
    path: Path, observations: Sequence[Observations], deviation_factor: FloatArray | None = None
) -> None:
    """Write observations of one robot over one or several windows.

    Parameters
    ----------
    path : Path
        information.npz.
    observations : sequence of Observations
        All of one layout.
    deviation_factor : (p, r) float64, optional
        L of the estimate's covariance L Lᵀ, for those who want its intervals.
    """
    layout = observations[0].layout
    content: dict[str, Any] = {
        "format": np.array(FORMAT),
        "coordinates": np.array(layout.coordinates),
        "parameters": np.array(layout.parameters),
        "structure": layout.structure,
        "window": np.array([one.window for one in observations]),
        "inflation": np.array([one.inflation for one in observations]),
        "kept": np.array([one.kept for one in observations]),
    }
    upper = np.triu_indices(layout.width)
    for index, one in enumerate(observations):
        content |= {
            f"rows_{index}": one.rows.factor[upper],
            f"noise_{index}": one.noise.factor[upper],
            f"samples_{index}": np.array([one.rows.samples, one.noise.samples]),
            f"counts_{index}": one.counts,
        }
    if deviation_factor is not None:
        content["deviation_factor"] = deviation_factor
    write_through(path, lambda stream: np.savez_compressed(stream, **content))


def load_archive(path: Path) -> tuple[Observations, ...]:
    """Read the observations of information.npz.

    Raises
    ------
    EstimateError
        When the file is missing or is none.
    """
    content = _read(path)
    try:
        if int(content["format"]) != FORMAT:
            raise EstimateError(
                f"{path}: written in format {int(content['format'])}, this is {FORMAT}; identify "
                "the log again"
            )
        layout = _layout(content)
        return tuple(
            Observations(
                rows=_information(layout, content[f"rows_{i}"], content[f"samples_{i}"][0]),
                noise=_information(layout, content[f"noise_{i}"], content[f"samples_{i}"][1]),
                counts=_counts(content[f"counts_{i}"], layout),
                window=float(window),
                inflation=float(inflation),
                kept=_share(kept),
            )
            for i, (window, inflation, kept) in enumerate(
                zip(content["window"], content["inflation"], content["kept"], strict=True)
            )
        )
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise EstimateError(
            f"{path}: no information.npz of symbid identify ({type(error).__name__}: {error})"
        ) from None


def load_deviation_factor(path: Path) -> FloatArray | None:
    """Return L (p, r) of the estimate's covariance L Lᵀ, None where the method gave none.

    Raises
    ------
    EstimateError
        When the file is missing or is none.
    """
    factor = _read(path).get("deviation_factor")
    if factor is None:
        return None
    if factor.ndim != 2 or factor.dtype != np.float64 or not np.all(np.isfinite(factor)):
        raise EstimateError(f"{path}: its deviation_factor is none; identify the log again")
    return factor


def _information(layout: RowLayout, triangle: FloatArray, samples: int) -> Information:
    if triangle.shape != (layout.width * (layout.width + 1) // 2,):
        raise ValueError("a factor is not as wide as its layout")
    factor = np.zeros((layout.width, layout.width), order="F")
    factor[np.triu_indices(layout.width)] = triangle
    count = float(samples)
    if not (np.all(np.isfinite(factor)) and np.isfinite(count)):
        raise ValueError("a number is not finite")
    return Information(layout, factor, count)


def _share(kept: float) -> float:
    if not 0 <= kept <= 1:
        raise ValueError("a share is none")
    return float(kept)


def _layout(content: dict[str, np.ndarray]) -> RowLayout:
    coordinates = tuple(content["coordinates"].tolist())
    parameters = tuple(content["parameters"].tolist())
    structure = content["structure"].astype(bool)
    if structure.shape != (len(coordinates), len(parameters)):
        raise ValueError("its structure is not that of its parameters")
    return RowLayout(coordinates, parameters, structure)


def _counts(counts: np.ndarray, layout: RowLayout) -> FloatArray:
    n = len(layout.coordinates)
    if counts.shape != (n, n) or not np.all(np.isfinite(counts)):
        raise ValueError("its counts are none")
    return counts.astype(np.float64)


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        # A lone array is no context: that is the TypeError below.
        _check_sizes(path)
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except OSError as error:
        reason = error.strerror or "not a zip of arrays"
        raise EstimateError(f"{path}: cannot read it ({reason}); check the path") from None
    except (ValueError, TypeError, zipfile.BadZipFile, zlib.error, EOFError, AttributeError):
        # NumPy's own words advise to load it as a pickle.
        raise EstimateError(
            f"{path}: no information.npz of symbid identify; give the file that a run wrote"
        ) from None


def _check_sizes(path: Path) -> None:
    """Refuse arrays that are larger than their bytes or than any run's, before they are made."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MAX_ARRAYS or sum(one.file_size for one in members) > MAX_BYTES:
            raise EstimateError(
                f"{path}: more than {MAX_ARRAYS} arrays or {MAX_BYTES >> 20} MiB unpacked, the "
                "limits; identify fewer logs at a time"
            )
        for member in members:
            with archive.open(member) as stream:
                shape, kind = _stated(stream)
                if math.prod(shape) * kind.itemsize != member.file_size - stream.tell():
                    raise ValueError("an array is not as large as it says")


def _stated(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type that an array's header states."""
    npy = np.lib.format
    is_first = npy.read_magic(stream) == (1, 0)
    read = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
    try:
        shape, _, kind = read(stream)
    except (SyntaxError, TokenError, RecursionError, MemoryError):
        # Of a header that is no Python literal NumPy lets the parser's own errors through.
        raise ValueError("an array has no header") from None
    return shape, kind
