"""What each parameter of a rigid body adds to its momentum, or to the wrench that moves it."""

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import pseudo_inertia
from symbid_ros.model.parameters import ParameterSet

# J of one unit of each parameter, (10, 16).
UNIT_PSEUDO_INERTIA = pseudo_inertia(np.eye(10)).reshape(10, 16)


def body_integrals(parameters: ParameterSet, pose: FloatArray, pose_rate: FloatArray) -> FloatArray:
    """Return ∫ (x × u; u) dm about the base's origin per unit parameter, (N, 6, inertial).

    A body's points x = X ξ, ξ homogeneous in link axes, have rates u = U ξ, so that
    ∫ x uᵀ dm = X J Uᵀ with the pseudo-inertia J = ∫ ξξᵀ dm, linear in the parameters
    (Wensing, Kim and Slotine 2018). With u = ẋ the integral is the body's momentum. With
    u = ẍ - g it is the wrench that moves it, bX_l^F A_l of Eq. 11 and 14; the thesis's -S(ṗ)
    of Eq. 2.38 comes out as -S(p̈), as it must.

    Parameters
    ----------
    parameters : ParameterSet
        Which links have parameters.
    pose, pose_rate : (3, 4, L, N) float64
        X and U of all links, in base axes: rotation (or its rate), then origin (or its rate).
    """
    if len(parameters.links) < pose.shape[2]:
        pose, pose_rate = pose[:, :, parameters.links], pose_rate[:, :, parameters.links]
    links, count = pose.shape[2:]
    integrals = np.empty((6, links, 10, count))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        # One axis at a time: the products of all three would not fit the cache.
        products = pose[i, :, None] * pose_rate[j]
        products -= pose[j, :, None] * pose_rate[i]
        moment = UNIT_PSEUDO_INERTIA @ products.reshape(16, links * count)
        integrals[axis] = moment.reshape(10, links, count).swapaxes(0, 1)
    integrals[3:, :, 0] = pose_rate[:, 3]
    integrals[3:, :, 1:4] = pose_rate[:, :3].swapaxes(1, 2)
    integrals[3:, :, 4:] = 0.0
    return integrals.reshape(6, parameters.inertial, count).transpose(2, 0, 1)
