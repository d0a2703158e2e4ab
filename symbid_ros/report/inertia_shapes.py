"""Boxes and ellipsoids that show inertias and the uncertainty of centres of mass."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import com_from_phi, phi_from_com, second_moments

# Corners of a unit cube, and the pairs of them that edges join.
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
BOX_EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(_CUBE[a] - _CUBE[b]).sum() == 1.0]
# Negative second moments below this share of the largest are rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class InertiaBox:
    """The homogeneous box that has the inertia of a link.

    Attributes
    ----------
    mass : float
        kg.
    com : (3,) float64
        Its centre in the link's frame, m.
    rotation : (3, 3) float64
        From the axes of its edges, the principal axes, to the link's axes.
    size : (3,) float64
        Lengths of its edges, m.
    """

    mass: float
    com: FloatArray
    rotation: FloatArray
    size: FloatArray

    @property
    def own_corners(self) -> FloatArray:
        """(8, 3) corners along its own axes from its centre, m."""
        corners: FloatArray = _CUBE * self.size
        return corners

    @property
    def corners(self) -> FloatArray:
        """(8, 3) corners in the link's frame, m."""
        corners: FloatArray = self.own_corners @ self.rotation.T + self.com
        return corners


@dataclass(frozen=True)
class ComEllipsoid:
    """Where a centre of mass lies: one standard deviation along each of three axes.

    Attributes
    ----------
    rotation : (3, 3) float64
        From the ellipsoid's axes to the link's axes.
    std : (3,) float64
        Standard deviations along these axes, m.
    """

    rotation: FloatArray
    std: FloatArray


def inertia_box(phi: FloatArray) -> InertiaBox | None:
    """Return the box with the inertia of φ (10,); None if no rigid body has it.

    A homogeneous box with edges a, b, c has the moments m (b² + c²)/12 and so on, thus the central
    second moments ∫x² dm = m a²/12.
    """
    mass, com, central = com_from_phi(phi)
    if mass <= 0:
        return None
    moments, axes = np.linalg.eigh(second_moments(phi_from_com(mass, np.zeros(3), central)))
    if moments[0] < -_ROUNDING * max(moments[-1], 0.0) or moments[-1] < 0:
        return None
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # right-handed
    size: FloatArray = np.sqrt(12 * np.maximum(moments, 0.0) / mass)
    return InertiaBox(mass, com, axes, size)


def principal_moments(phi: FloatArray) -> FloatArray:
    """Return the principal moments of inertia (3,) about the centre of mass, kg m², ascending."""
    moments = np.linalg.eigvalsh(com_from_phi(phi)[2])
    return moments.astype(np.float64)


def com_covariance(phi: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) in m² of the centre of mass, to first order.

    Parameters
    ----------
    phi : (10,) float64
        Parameters of a link with mass.
    covariance : (10, 10) float64
        Their covariance.
    """
    slope = np.hstack([-phi[1:4, None] / phi[0], np.eye(3)]) / phi[0]
    result: FloatArray = slope @ covariance[:4, :4] @ slope.T
    return result


def com_ellipsoid(phi: FloatArray, covariance: FloatArray) -> ComEllipsoid:
    """Return the ellipsoid of :func:`com_covariance`."""
    variances, axes = np.linalg.eigh(com_covariance(phi, covariance))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return ComEllipsoid(axes, np.sqrt(np.maximum(variances, 0.0)))


def link_covariance(
    estimate: Estimate, first: int, deviation_factor: FloatArray | None = None
) -> FloatArray | None:
    """Return the covariance (10, 10) of a link's parameters; None if the method gives none.

    Parameters
    ----------
    estimate : Estimate
        The estimate.
    first : int
        Index of the link's mass in the estimate.
    deviation_factor : (p, r) float64, optional
        L of the covariance L Lᵀ. Without it, the parameters count as independent.
    """
    if estimate.std is None:
        return None
    own = slice(first, first + 10)
    if deviation_factor is None:
        return np.diag(estimate.std[own] ** 2)
    factor = deviation_factor[own]
    covariance: FloatArray = factor @ factor.T
    return covariance


def total_com(phi: FloatArray, rotations: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the centre of mass (3,) of links φ (L, 10), in the axes of their poses.

    Parameters
    ----------
    phi : (L, 10) float64
        Parameters of the links.
    rotations, positions : (L, 3, 3) and (L, 3) float64
        Poses of their frames, m. Without a mass, the result is zero.
    """
    mass = phi[:, 0]
    first = np.einsum("lij,lj->i", rotations, phi[:, 1:4]) + mass @ positions
    total: FloatArray = first / mass.sum() if mass.sum() else np.zeros(3)
    return total
