"""information.npz: the observations of a run, from which the next run can continue."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.atomic_write import write_through
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.group_moments import (
    GROUPS,
    CoordinateMoments,
    CoordinateRows,
    GroupMoments,
)
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.npz_file import check_unpacked_size, read_arrays
from symbid_ros.estimation.observations import Observations, covered_seconds
from symbid_ros.estimation.row_layout import RowLayout

FORMAT = 4  # format 3 had triangles only
DENSE_FORMAT = 2  # of earlier versions, with all zeros, both halves of moments, and all copies
ARCHIVE = "an information.npz"
SLIPPING, NUMBERS = "slipping_", "numbers_"  # parts of names of arrays
LARGEST_ENTRY = 1e15  # far above an hour of large forces at a high rate


@dataclass(frozen=True)
class SensorCalibration:
    """What predictions with identified sensor errors need in addition to their values.

    Attributes
    ----------
    factor : (s, r) float64
        The sensor errors' rows of L, where L Lᵀ is the covariance of all unknowns.
    linearization : (p + s,) float64
        Parameters and sensor errors at which the rows were linearized.
    """

    factor: FloatArray
    linearization: FloatArray


def write_archive(
    path: Path,
    observations: Sequence[Observations],
    deviation_factor: FloatArray | None = None,
    calibration: SensorCalibration | None = None,
    correlation: FloatArray | None = None,
) -> None:
    """Write observations of one robot over one or several windows.

    Parameters
    ----------
    path : Path
        File to write, information.npz.
    observations : sequence of Observations
        Observations with the same layout.
    deviation_factor : (p, r) float64, optional
        Factor L of the estimate's covariance L Lᵀ, from which intervals can be computed.
    calibration : SensorCalibration, optional
        Of the sensor errors, if they were identified.
    correlation : (n, n) float64, optional
        Of the residuals of a row's coordinates.
    """
    content = pack_observations(observations)
    if deviation_factor is not None:
        content["deviation_factor"] = deviation_factor
    if calibration is not None:
        content["sensor_factor"] = calibration.factor
        content["linearization"] = calibration.linearization
    if correlation is not None:
        content["row_correlation"] = correlation
    # Random digits, as zeros are left out: compression would take longer than all the rest.
    write_through(path, lambda stream: np.savez(stream, **content))


def pack_observations(observations: Sequence[Observations]) -> dict[str, Any]:
    """Return observations with the same layout as the arrays of an information.npz."""
    layout = observations[0].layout
    content: dict[str, Any] = {
        "format": np.array(FORMAT),
        "coordinates": np.array(layout.coordinates),
        "parameters": np.array(layout.parameters),
        "structure": layout.structure,
        "combined": np.array(layout.combined, dtype=np.int64),
        "window": np.array([one.window for one in observations]),
        "inflation": np.array([one.inflation for one in observations]),
        "kept": np.array([one.kept for one in observations]),
        "seconds": np.array(sorted(covered_seconds(observations)), dtype=np.int64),
    }
    shared: list[str] = []
    for index, one in enumerate(observations):
        arrays = _arrays(one, str(index))
        content |= arrays
        if one.slipping is None:
            continue
        for name, values in _arrays(one.slipping, f"{SLIPPING}{index}").items():
            # They are the same where no joint sticks.
            twin = arrays.get(name.replace(SLIPPING, ""))
            if twin is not None and np.array_equal(values, twin):
                shared.append(name)
            else:
                content[name] = values
    return content | {"shared": np.array(shared, dtype=np.str_)}


def _arrays(one: Observations, key: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of one window length; ``key`` ends their names."""
    both = one.rows, one.noise
    arrays = {
        **_without_zeros(f"rows_{key}", _stored_factor(one.rows)),
        **_without_zeros(f"noise_{key}", _stored_factor(one.noise)),
        f"heights_{key}": np.array([len(each.factor) for each in both], dtype=np.int64),
        f"samples_{key}": np.array([each.samples for each in both]),
        f"counts_{key}": one.counts,
    }
    if one.groups is not None:
        arrays[f"group_counts_{key}"] = one.groups.counts
        parts = one.groups.parts
        moments = [_stored_moments(each, one.layout).ravel() for each in parts]
        arrays |= _without_zeros(f"groups_{key}", np.concatenate(moments))
        arrays[f"group_columns_{key}"] = np.concatenate(
            [np.column_stack([np.full(len(one.left), one.coordinate), one.left]) for one in parts]
        )
    return arrays


def _stored_factor(information: Information) -> FloatArray:
    """Return the numbers of a factor (r, w), without those below a triangle."""
    factor, width = information.factor, information.layout.width
    return factor[np.triu_indices(width)] if len(factor) == width else factor.ravel()


def _stored_moments(part: CoordinateMoments | CoordinateRows, layout: RowLayout) -> FloatArray:
    """Return the moments (GROUPS, ...) of a coordinate; one half if they are symmetric."""
    width = len(layout.columns[part.coordinate]) + 1
    if len(part.left) < width:
        return part.moments
    return part.moments[(slice(None), *np.triu_indices(width))]


def _without_zeros(name: str, values: FloatArray) -> dict[str, NDArray[Any]]:
    """Return an array (N,) without its zeros, and a bit mask of the other numbers.

    A short log fills few rows of a factor, and some candidate terms never act.
    """
    is_number = (values != 0) | np.signbit(values)
    if is_number.all():
        return {name: values}
    return {name: values[is_number], NUMBERS + name: np.packbits(is_number)}


def _with_zeros(content: Mapping[str, NDArray[Any]], name: str, size: int) -> NDArray[Any]:
    """Return an array, with the zeros that :func:`_without_zeros` left out of its N = ``size``."""
    found = content[name]
    bits = content.get(NUMBERS + name)
    if bits is None:
        return found
    expected = ((size + 7) // 8,)
    _require(
        bits.dtype == np.uint8 and bits.shape == expected,
        f"{NUMBERS}{name} has shape {bits.shape}, not {expected} bytes",
    )
    is_number = np.unpackbits(bits, count=size).astype(bool)
    count = int(np.count_nonzero(is_number))
    _require(found.shape == (count,), f"{name} has shape {found.shape}, not {(count,)}")
    values = np.zeros(size, dtype=found.dtype)
    values[is_number] = found
    return values


def load_archive(path: Path) -> tuple[Observations, ...]:
    """Read the observations of information.npz.

    Raises
    ------
    EstimateError
        When the file is missing, damaged or not an information.npz.
    """
    content = read_arrays(path, ARCHIVE)
    try:
        if not DENSE_FORMAT <= int(content["format"]) <= FORMAT:
            raise EstimateError(
                f"{path}: written in format {int(content['format'])}, this version reads "
                f"{DENSE_FORMAT} to {FORMAT}; identify the log again",
                "E411",
            )
        check_unpacked_size(
            path, 64 * sum(one.size for name, one in content.items() if NUMBERS in name)
        )
        return unpack_observations(content)
    except KeyError as error:
        reason = f"it lacks {error}"
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        reason = str(error)
    raise EstimateError(
        f"{path}: not an information.npz ({reason}); give the file that `symbid identify` wrote",
        "E410",
    )


def unpack_observations(content: dict[str, np.ndarray]) -> tuple[Observations, ...]:
    """Return the observations in the arrays of an information.npz.

    Raises
    ------
    KeyError, ValueError, TypeError, IndexError, OverflowError
        When an array is missing or invalid.
    """
    shared = [str(name) for name in content.get("shared", np.zeros(0)).tolist()]
    _require(all(name.count(SLIPPING) == 1 for name in shared), "its shared arrays have no owner")
    content = content | {name: content[name.replace(SLIPPING, "")] for name in shared}
    layout = _layout(content)
    windows, inflations, kept = (
        _numbers(content, name, (len(content["window"]),))
        for name in ("window", "inflation", "kept")
    )
    _require(np.all(inflations >= 1), "inflation must be at least 1")
    _require(np.all(kept <= 1), "kept must be at most 1")
    seconds = _seconds(content)
    return tuple(
        _observations(
            layout,
            content,
            str(i),
            Observations.empty(layout, float(windows[i])),
            inflation=float(inflations[i]),
            kept=float(kept[i]),
            seconds=seconds,
        )
        for i in range(len(windows))
    )


def load_deviation_factor(path: Path) -> FloatArray | None:
    """Return L (p, r) of the estimate's covariance L Lᵀ, or None if the method gave none.

    Raises
    ------
    EstimateError
        When the file is missing, damaged or not an information.npz.
    """
    factor = read_arrays(path, ARCHIVE).get("deviation_factor")
    if factor is not None and not (factor.ndim == 2 and _is_finite(factor)):
        raise EstimateError(
            f"{path}: its deviation_factor is not a finite matrix; identify the log again", "E410"
        )
    return factor


def load_correlation(path: Path) -> FloatArray | None:
    """Return the correlation (n, n) of the residuals of a row's coordinates, or None.

    Raises
    ------
    EstimateError
        When the file is missing, damaged or not an information.npz.
    """
    content = read_arrays(path, ARCHIVE)
    correlation = content.get("row_correlation")
    if correlation is None:
        return None
    n = len(content["coordinates"])
    if correlation.shape != (n, n) or not _is_finite(correlation):
        raise EstimateError(
            f"{path}: its row_correlation is not a finite matrix; identify the log again", "E410"
        )
    return correlation


def load_calibration(path: Path) -> SensorCalibration | None:
    """Return what predictions with sensor errors need, or None if none were identified.

    Raises
    ------
    EstimateError
        When the file is missing, damaged or not an information.npz.
    """
    content = read_arrays(path, ARCHIVE)
    factor, linearization = (content.get(name) for name in ("sensor_factor", "linearization"))
    if factor is None or linearization is None:
        return None
    has_dimensions = factor.ndim == 2 and linearization.ndim == 1
    if not (has_dimensions and _is_finite(factor) and _is_finite(linearization)):
        raise EstimateError(
            f"{path}: its sensor_factor or linearization is not a finite array; identify the log "
            "again",
            "E410",
        )
    return SensorCalibration(factor, linearization)


def _is_finite(array: NDArray[Any]) -> bool:
    return array.dtype == np.float64 and bool(np.all(np.isfinite(array)))


def _observations(
    layout: RowLayout,
    content: dict[str, np.ndarray],
    key: str,
    empty: Observations,
    **common: Any,
) -> Observations:
    """Return the observations of one window length from the arrays whose names end in ``key``."""
    slipping = f"{SLIPPING}{key}"
    return replace(
        empty,
        rows=_information(layout, content, "rows", key),
        noise=_information(layout, content, "noise", key),
        counts=_counts(content, key, layout),
        groups=_groups(content, key, layout),
        slipping=_observations(layout, content, slipping, empty, **common)
        if f"rows_{slipping}" in content and SLIPPING not in key
        else None,
        **common,
    )


def _groups(content: dict[str, np.ndarray], key: str, layout: RowLayout) -> GroupMoments | None:
    if f"groups_{key}" not in content:
        return None
    shapes = _group_shapes(content, key, layout)
    widths = [len(layout.columns[i]) + 1 for i, _ in shapes]
    is_half = [
        int(content["format"]) != DENSE_FORMAT and len(left) == width
        for (_, left), width in zip(shapes, widths, strict=True)
    ]
    sizes = [
        GROUPS * (width * (width + 1) // 2 if half else len(left) * width)
        for (_, left), width, half in zip(shapes, widths, is_half, strict=True)
    ]
    flat = _numbers(content, f"groups_{key}", (sum(sizes),), least=-LARGEST_ENTRY)
    parts = []
    for (i, left), width, half, moments in zip(
        shapes, widths, is_half, np.split(flat, np.cumsum(sizes)[:-1]), strict=True
    ):
        one = moments.reshape(GROUPS, -1) if half else moments.reshape(GROUPS, len(left), width)
        parts.append(CoordinateMoments(i, left, _symmetric(one, width) if half else one))
    counts = _numbers(content, f"group_counts_{key}", (GROUPS, len(layout.coordinates)))
    return GroupMoments(layout, tuple(parts), counts)


def _symmetric(half: FloatArray, width: int) -> FloatArray:
    """Return symmetric matrices (k, w, w) from their upper halves (k, w (w + 1) / 2)."""
    rows, columns = np.triu_indices(width)
    found = np.empty((len(half), width, width))
    found[:, rows, columns] = half
    found[:, columns, rows] = half
    return found


def _group_shapes(
    content: dict[str, np.ndarray], key: str, layout: RowLayout
) -> list[tuple[int, IntArray]]:
    """Return the coordinates that have moments, each with the columns on the left."""
    name = f"group_columns_{key}"
    if name not in content:  # earlier versions wrote all moments of joints with candidate terms
        return [(i, np.arange(len(layout.columns[i]) + 1)) for i in layout.own_coordinates]
    found = content[name]
    _require(found.ndim == 2 and found.shape[1] == 2, f"{name} must have two columns")
    _require(found.dtype.kind == "i", f"{name} must be integers")
    _require(
        np.all((found >= 0) & (found[:, :1] < len(layout.coordinates))), f"{name} is out of range"
    )
    shapes = []
    for i in np.unique(found[:, 0]).tolist():
        left = found[found[:, 0] == i, 1]
        _require(np.all(np.diff(left) > 0), f"{name} must be ascending")
        _require(left[-1] <= len(layout.columns[i]), f"{name} is out of range")
        shapes.append((i, left))
    return shapes


def _information(
    layout: RowLayout, content: dict[str, np.ndarray], kind: str, key: str
) -> Information:
    width, is_rows = layout.width, kind == "rows"
    heights = content.get(f"heights_{key}", np.full(2, width))  # earlier versions wrote triangles
    _require(
        heights.shape == (2,) and heights.dtype.kind == "i" and np.all(heights >= 0),
        f"heights_{key} must be two integers that are not negative",
    )
    height = min(int(heights[0 if is_rows else 1]), width)
    is_triangle = height == width
    size = width * (width + 1) // 2 if is_triangle else height * width
    values = _numbers(content, f"{kind}_{key}", (size,), least=-LARGEST_ENTRY)
    if is_triangle:
        factor = np.zeros((width, width), order="F")
        factor[np.triu_indices(width)] = values
    else:
        factor = values.reshape(height, width)
    rows, noise = _numbers(content, f"samples_{key}", (2,))
    return Information(layout, factor, float(rows if is_rows else noise))


def _numbers(
    content: dict[str, np.ndarray], name: str, shape: tuple[int, ...], least: float = 0.0
) -> FloatArray:
    """Return an array of real numbers from ``least`` to ``LARGEST_ENTRY``."""
    found = _with_zeros(content, name, math.prod(shape))
    _require(found.shape == shape, f"{name} has shape {found.shape}, not {shape}")
    _require(found.dtype.kind in "fiu", f"{name} is of type {found.dtype}, not real numbers")
    numbers = found.astype(np.float64)
    # This comparison is False for NaN.
    _require(
        np.all((numbers >= least) & (numbers <= LARGEST_ENTRY)),
        f"{name} has a number that is not from {least:g} to {LARGEST_ENTRY:g}",
    )
    return numbers


def _require(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _layout(content: dict[str, np.ndarray]) -> RowLayout:
    coordinates = tuple(content["coordinates"].tolist())
    parameters = tuple(content["parameters"].tolist())
    structure = content["structure"].astype(bool)
    if structure.shape != (len(coordinates), len(parameters)):
        raise ValueError("its structure is not that of its parameters")
    # Archives of earlier versions have none.
    combined = content.get("combined", np.zeros(0)).astype(np.int64)
    if not np.all((combined >= 0) & (combined < len(coordinates))):
        raise ValueError("its combined coordinates are out of range")
    return RowLayout(coordinates, parameters, structure, tuple(combined.tolist()))


def _counts(content: dict[str, np.ndarray], key: str, layout: RowLayout) -> FloatArray:
    n = len(layout.coordinates)
    counts = _numbers(content, f"counts_{key}", (n, n))
    _require(
        np.array_equal(counts, counts.T) and np.all(counts <= counts.diagonal()),
        f"counts_{key} must be symmetric, and largest on its diagonal",
    )
    return counts


def _seconds(content: dict[str, np.ndarray]) -> frozenset[int]:
    """Return the fingerprints of the seconds covered, which earlier versions did not write."""
    seconds = content.get("seconds", np.zeros(0, dtype=np.int64))
    _require(seconds.ndim == 1 and seconds.dtype == np.int64, "seconds must be a list of integers")
    return frozenset(seconds.tolist())
