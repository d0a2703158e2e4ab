"""Arrays that users give: lists, NumPy arrays, also masked ones, and tables with named columns."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError


def number_array(what: str, values: ArrayLike, names: Sequence[str] = ()) -> FloatArray:
    """Return values as an array in which masked values are NaN.

    Parameters
    ----------
    what : str
        Name for messages.
    values : array_like
    names : sequence of str
        Columns of a table are taken by these names, if it has any of them.

    Raises
    ------
    DataError
        When a table lacks some of the names, or values are not an array of numbers.
    """
    chosen: Any = values
    given = [one for one in getattr(values, "columns", ()) if isinstance(one, str)]
    if set(given) & set(names):
        if missing := [name for name in names if name not in given]:
            raise DataError(f"{what} has no column {', '.join(missing)}; add it", "E511")
        chosen = chosen[list(names)]
    try:
        numbers = np.ma.asarray(chosen, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} is not an array of numbers ({error})", "E511") from None
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
    """Return times (N,) as ns: seconds, integer ns, or NumPy's times and durations.

    Raises
    ------
    DataError
        When the shape is wrong, or a value is masked, NaN, infinite or not in seconds.
    """
    given = np.asarray(time)
    if given.dtype.kind in "mM":
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
    return np.rint(numbers * 1e9).astype(np.int64)
