"""Arrays that users give: lists, NumPy arrays, also masked ones, and tables with named columns."""

import warnings
from collections.abc import Sequence
from datetime import datetime
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError

# Times are too coarse if they are rounded to more than this share of their mean step, and to more
# than this, s, which is finer than any clock that matters here.
MOST_ROUNDED, LEAST_ROUNDING = 0.5, 1e-6


def number_array(what: str, values: ArrayLike, names: Sequence[str] = ()) -> FloatArray:
    """Return values as an array in which masked values are NaN.

    Parameters
    ----------
    what : str
        Name for messages.
    values : array_like
    names : sequence of str
        Names of the columns of a table, which may be in any order. Columns that are numbered, as
        those of arrays, are in the order of these names.

    Raises
    ------
    DataError
        When a table lacks some of the names, or values are not an array of numbers.
    """
    chosen: Any = values
    columns = list(getattr(values, "columns", ()))
    if names and not all(isinstance(one, Integral) for one in columns):
        if missing := [name for name in names if name not in columns]:
            raise DataError(
                f"{what} has no column {', '.join(missing)}; its columns are "
                f"{', '.join(map(str, columns))}; give each the name of its joint, or give an "
                "array with one column for each joint in order",
                "E511",
            )
        chosen = chosen[list(names)]
    try:
        given = np.ma.asarray(chosen)
        if given.dtype == object and hasattr(chosen, "isna"):
            # No float has the value of a missing one of pandas.
            given = np.ma.asarray(chosen.astype(object).where(~chosen.isna(), np.nan))
        is_number = given.dtype.kind not in "cmM"  # NumPy converts these, too
        numbers: Any = given.astype(np.float64) if is_number else None
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} is not an array of numbers ({error})", "E511") from None
    if numbers is None:
        raise DataError(f"{what} is not an array of numbers: it is of {given.dtype}", "E511")
    return np.asarray(numbers.filled(np.nan))


def flag_array(what: str, values: ArrayLike) -> FloatArray:
    """Return a column (N, 1) of ones where values are true, and zeros.

    Raises
    ------
    DataError
        When values are masked or not an array of flags.
    """
    column = number_array(what, values).reshape(-1, 1)
    if np.isnan(column).any():
        raise DataError(f"{what} has masked or NaN values; give True or False for each", "E511")
    return np.asarray(column != 0.0, dtype=np.float64)


def instants(name: str, time: ArrayLike) -> IntArray:
    """Return times (N,) as ns: seconds, integer ns, or times and durations of NumPy and pandas.

    Times with a time zone are converted to UTC.

    Raises
    ------
    DataError
        When the shape is wrong, or a value is masked, NaN, infinite, not in seconds or rounded.
    """
    given = np.asarray(time)
    if given.dtype == object and given.size and isinstance(given.flat[0], datetime):
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            given = np.asarray(time, dtype="M8[ns]")  # NumPy warns that it converts to UTC
    if given.dtype.kind in "mM":
        if np.isnat(given).any():
            raise DataError(f"{name}: time has missing values (NaT); leave out their rows", "E518")
        given = given.astype(f"{given.dtype.kind}8[ns]").astype(np.int64)
    is_integer = np.issubdtype(given.dtype, np.integer) and not np.ma.is_masked(time)
    numbers = given if is_integer else number_array(f"{name}: time", time)
    if numbers.ndim != 1 or not len(numbers):
        raise DataError(f"{name}: time has shape {numbers.shape}, expected (N,) with N > 0", "E511")
    if is_integer:
        return numbers.astype(np.int64)
    # 2⁶² ns are 146 years. The limit leaves room for margins below the overflow of int64.
    if not (np.abs(numbers) < 2**62 * 1e-9).all():
        raise DataError(
            f"{name}: time is masked, NaN, infinite or not in seconds; use seconds or integer ns",
            "E518",
        )
    if given.dtype.kind == "f" and given.dtype.itemsize < numbers.itemsize:
        rounding = float(np.spacing(np.abs(given).max()))
        step = float(np.ptp(numbers)) / max(len(numbers) - 1, 1)
        if rounding > max(MOST_ROUNDED * step, LEAST_ROUNDING):
            raise DataError(
                f"{name}: time is of {given.dtype}, which rounds these times to "
                f"{rounding:.2g} s; give {numbers.dtype}, or subtract the first time before the "
                f"conversion to {given.dtype}",
                "E518",
            )
    return np.rint(numbers * 1e9).astype(np.int64)
