"""Cross products, rotations and the memory layout of blocks of samples.

The functions of this subpackage accept and return arrays with the sample axis first, (N, L, 3).
Inside, arrays are *component first*, (3, L, N), because NumPy is much faster along contiguous
samples than on stacks of small matrices.
"""

from collections.abc import Iterator

import numpy as np

from symbid_ros.arrays import FloatArray

# Links times samples in one block: large enough to outweigh the cost of NumPy calls, small enough
# for temporary arrays to fit the cache.
CACHE_BLOCK = 3200


def cache_blocks(count: int, links: int) -> Iterator[slice]:
    """Yield slices of ``count`` samples, each small enough for the cache."""
    size = max(1, CACHE_BLOCK // links)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def component_first(x: FloatArray) -> FloatArray:
    """Return (N, L, ...) as (..., L, N), contiguous; vectors become (3, L, N).

    A copy is needed because NumPy's results inherit the memory layout of their operands.
    """
    return np.ascontiguousarray(x.transpose(*range(2, x.ndim), 1, 0))


def sample_first(x: FloatArray) -> FloatArray:
    """Return (..., L, N) as a view (N, L, ...), the inverse of :func:`component_first`."""
    return x.transpose(x.ndim - 1, x.ndim - 2, *range(x.ndim - 2))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b of component-first vectors (3, ...), with broadcasting."""
    a, b = a[[1, 2, 0, 1]], b[[1, 2, 0, 1]]
    product: FloatArray = a[:3] * b[1:]
    product -= a[1:] * b[:3]
    return product


def skew(x: FloatArray) -> FloatArray:
    """Return S(x) (3, 3, ...) of vectors (3, ...), S(x) y = x × y (Eq. 12)."""
    matrix = np.zeros((3, *x.shape))
    matrix[[2, 0, 1], [1, 2, 0]] = x
    matrix[[1, 2, 0], [2, 0, 1]] = -x
    return matrix


def matvec(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the products of component-first matrices (3, 3, ...) and vectors (3, ...)."""
    turned: FloatArray = np.einsum("ij...,j...->i...", rotation, vector)
    return turned


def rotate(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return rotation (..., 3, 3) applied to vectors (..., 3), with broadcasting."""
    rotated: FloatArray = np.einsum("...ij,...j->...i", rotation, vector)
    return rotated


def rotate_inverse(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the transposed rotation (..., 3, 3) applied to vectors (..., 3)."""
    rotated: FloatArray = np.einsum("...ji,...j->...i", rotation, vector)
    return rotated
