"""LAPACK's QR update of a triangular factor, called without the interpreter lock.

``scipy.linalg.lapack.dtpqrt`` holds the lock, so that threads would fold one after another. The
same routine is reached through the function pointers that SciPy exports for Cython.
"""

import ctypes
from collections.abc import Callable

import numpy as np
from scipy.linalg import cython_lapack

from symbid_ros.arrays import FloatArray

BLOCK = 32  # columns that LAPACK eliminates at once


def _routine(name: str, arguments: int) -> Callable[..., None]:
    """Return a LAPACK routine; ctypes releases the interpreter lock while it runs."""
    capsule = dict[str, object](cython_lapack.__pyx_capi__)[name]
    name_of = ctypes.pythonapi.PyCapsule_GetName
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of = ctypes.pythonapi.PyCapsule_GetPointer
    pointer_of.restype = ctypes.c_void_p
    pointer_of.argtypes = [ctypes.py_object, ctypes.c_char_p]
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)
    return kind(pointer_of(capsule, name_of(capsule)))


_DTPQRT = _routine("dtpqrt", 12)


def fold_rows(factor: FloatArray, rows: FloatArray) -> None:
    """Fold rows into a triangular factor; both arrays are overwritten.

    Parameters
    ----------
    factor : (w, w) float64, Fortran order
        Upper triangular R; afterwards RᵀR has grown by rowsᵀ rows.
    rows : (N, w) float64, Fortran order
    """
    count, width = rows.shape
    if not count or not width:
        return
    for array in (factor, rows):
        if not (array.flags.f_contiguous and array.dtype == np.float64):
            raise ValueError("LAPACK needs float64 in Fortran order")
    block = min(BLOCK, width)
    triangle = np.empty((block, width), order="F")
    work = np.empty(block * width)
    sizes = {
        name: ctypes.c_int(value) for name, value in (("m", count), ("n", width), ("k", block))
    }
    none, info = ctypes.c_int(0), ctypes.c_int(0)
    m, n, k = (ctypes.byref(sizes[name]) for name in "mnk")
    _DTPQRT(
        m,
        n,
        ctypes.byref(none),
        k,
        factor.ctypes.data,
        n,
        rows.ctypes.data,
        m,
        triangle.ctypes.data,
        k,
        work.ctypes.data,
        ctypes.byref(info),
    )
    if info.value:
        raise ValueError(f"LAPACK dtpqrt rejected argument {-info.value}")
