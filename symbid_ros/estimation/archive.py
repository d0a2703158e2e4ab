"""information.npz: what a run knows, so that the next can go on from it."""

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic import write_through
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.layout import RowLayout
from symbid_ros.estimation.observations import Observations

FORMAT = 1


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
            )
            for i, (window, inflation) in enumerate(
                zip(content["window"], content["inflation"], strict=True)
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
    return None if factor is None else np.asarray(factor, dtype=np.float64)


def _information(layout: RowLayout, triangle: FloatArray, samples: int) -> Information:
    factor = np.zeros((layout.width, layout.width), order="F")
    factor[np.triu_indices(layout.width)] = triangle
    if not np.all(np.isfinite(factor)):
        raise ValueError("a number is not finite")
    return Information(layout, factor, int(samples))


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
