"""Types of the arrays that modules exchange, and operations on all arrays of a dataclass."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

S = TypeVar("S", np.float64, np.int64)
D = TypeVar("D", bound="DataclassInstance")


def distinct(values: NDArray[S]) -> NDArray[S]:
    """Return the distinct values in ascending order.

    NumPy's ``unique`` hashes them, which takes several times as long for stamps and readings.
    """
    if len(values) < 2 or np.all(values[1:] > values[:-1]):
        return values
    ordered = np.sort(values)
    found: NDArray[S] = ordered[np.append(True, ordered[1:] != ordered[:-1])]
    return found


def map_arrays(instance: D, function: Callable[[NDArray[Any]], NDArray[Any]]) -> D:
    """Return a dataclass instance with a function applied to each field that is an array."""
    arrays: dict[str, Any] = {
        field.name: function(value)
        for field in fields(instance)
        if isinstance(value := getattr(instance, field.name), np.ndarray)
    }
    return replace(instance, **arrays)


def concatenated(instances: Sequence[D]) -> D:
    """Join dataclass instances along the first axis of each array; other fields must be equal."""
    first = instances[0]
    arrays: dict[str, Any] = {
        field.name: np.concatenate([getattr(one, field.name) for one in instances])
        for field in fields(first)
        if isinstance(getattr(first, field.name), np.ndarray)
    }
    return replace(first, **arrays)
