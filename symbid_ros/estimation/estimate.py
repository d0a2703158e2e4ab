"""An identified parameter vector with everything that is known about it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """The result of one identification.

    Attributes
    ----------
    method : str
        ``ols``, ``wls_r``, ``wls_c`` or ``wls_rc``.
    model : str
        Name of the robot model.
    names : tuple of str
        Parameter names, ``<link>/<m|mc_x|...|Izz>`` or ``<joint>/<viscous|coulomb>``.
    units : tuple of str
        SI unit of each parameter.
    value, prior : (p,) float64
        Estimate and prior mean.
    std : (p,) float64 or None
        Standard deviation of the estimate; None where the method gives none.
    determined : (p,) bool or None
        Whether the data, not the prior, decide the value; None where the
        method cannot tell.
    rank : int
        Number of singular values used (the thesis's z).
    condition : float
        Ratio of the largest to the smallest singular value used.
    samples : int
        Samples folded into the information.
    residual_rmse : dict of str to float
        Per coordinate (``base/moment_x`` ... ``base/force_z``, joint names), Nm or N.
    consistent : dict of str to bool
        Per link: mass and pseudo-inertia positive definite.
    inputs : tuple of str
        Bags, model and prior, as given.
    software : str
        Name and version of what computed it.
    """

    method: str
    model: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: FloatArray
    prior: FloatArray
    std: FloatArray | None
    determined: NDArray[np.bool_] | None
    rank: int
    condition: float
    samples: int
    residual_rmse: dict[str, float]
    consistent: dict[str, bool]
    inputs: tuple[str, ...]
    software: str
