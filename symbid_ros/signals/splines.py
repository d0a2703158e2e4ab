"""Interpolating splines through samples.

SciPy's interpolation takes as long to load as a short log to read, and most logs need none.
"""

from typing import TYPE_CHECKING

from symbid_ros.arrays import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


def interpolating_spline(seconds: FloatArray, values: FloatArray, degree: int = 3) -> "BSpline":
    """Return the spline through values (N, ...) at increasing times (N,), s.

    Its degree is lower if there are not enough values.
    """
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415

    spline: BSpline = make_interp_spline(seconds, values, k=min(degree, len(seconds) - 1))
    return spline
