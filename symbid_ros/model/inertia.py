"""The ten inertial parameters of a link, φ = [m, m·c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz].

The inertia is about the link's origin. Products of inertia are matrix elements,
Ixy = -∫xy dm (thesis, Eq. 2.27).
"""

import numpy as np

from symbid_ros.arrays import FloatArray

PARAMETERS = ("m", "mc_x", "mc_y", "mc_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
UNITS = ("kg", *("kg m",) * 3, *("kg m^2",) * 6)

_UPPER = np.triu_indices(3)

# A moving link lighter than LEAST_MASS kg counts as massless: MuJoCo requires more than 1e-15 kg
# and a central inertia above 1e-14 kg m². Such a link is written with TINY_MASS and a radius of
# some millimetres: MuJoCo compiles it, and its effect on the motion is negligible.
LEAST_MASS = 1e-14
TINY_MASS = 1e-9
_LEAST_SECOND_MOMENT = 1e-14
# Laminas and rods lie on the boundary of physical consistency, which rounding may cross.
_BOUNDARY = 1e-12
# Share of a body's second moments that rounding may make negative.
_ROUNDING = 1e-9


def inertia_matrix(phi: FloatArray) -> FloatArray:
    """Return the inertia (..., 3, 3) about the link origin of φ (..., 10)."""
    matrix = np.empty((*phi.shape[:-1], 3, 3))
    matrix[..., _UPPER[0], _UPPER[1]] = phi[..., 4:]
    matrix[..., _UPPER[1], _UPPER[0]] = phi[..., 4:]
    return matrix


def phi_from_com(mass: float, com: FloatArray, inertia_com: FloatArray) -> FloatArray:
    """Return φ (10,) of a body from its mass, centre of mass and central inertia.

    Parameters
    ----------
    mass : float
        kg.
    com : (3,) float64
        Centre of mass in the link frame, m.
    inertia_com : (3, 3) float64
        Inertia about the centre of mass, in link axes, kg m².
    """
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, (inertia_com + steiner)[_UPPER]])


def com_from_phi(phi: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass (3,) and central inertia (3, 3) of φ (10,).

    A link without mass keeps its inertia; its centre of mass is set to the origin.
    """
    mass = float(phi[0])
    com = phi[1:4] / mass if mass != 0.0 else np.zeros(3)
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, inertia_matrix(phi) - steiner


def transform_phi(phi: FloatArray, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return φ (10,) of a body in another frame.

    Parameters
    ----------
    phi : (10,) float64
        Parameters in the body's own frame b.
    rotation, translation : (3, 3) and (3,) float64
        Pose of b in the new frame a: x_a = rotation @ x_b + translation.
    """
    mass, first = phi[0], rotation @ phi[1:4]
    # Second moments transform without a division by mass, so zero and negative masses are valid.
    second = rotation @ second_moments(phi) @ rotation.T
    cross = np.outer(first, translation)
    second = second + cross + cross.T + mass * np.outer(translation, translation)
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate([[mass], first + mass * translation, inertia[_UPPER]])


def second_moments(phi: FloatArray) -> FloatArray:
    """Return ∫ x xᵀ dm (..., 3, 3) about the link origin of φ (..., 10)."""
    inertia = inertia_matrix(phi)
    trace: FloatArray = np.trace(inertia, axis1=-2, axis2=-1)[..., None, None]
    return 0.5 * trace * np.eye(3) - inertia


def ball_density(phi: FloatArray) -> float:
    """Return the density of the ball with the mass and the mean inertia of φ (10,), kg/m³.

    It is infinite for a point, and at most that of a body with this inertia.
    """
    mass, _, central = com_from_phi(phi)
    square = max(float(np.trace(central)), 0.0) / 2 / mass  # mean square extent
    return mass / (4 / 3 * np.pi * (5 / 3 * square) ** 1.5) if square > 0 else np.inf


def pseudo_inertia(phi: FloatArray) -> FloatArray:
    """Return the pseudo-inertia (..., 4, 4) [[∫xxᵀ, m·c], [m·cᵀ, m]] of φ (..., 10).

    It is positive definite if and only if some mass density realises φ (Wensing, Kim and
    Slotine 2018, IEEE RA-L 3(1), Eq. 11).
    """
    matrix = np.empty((*phi.shape[:-1], 4, 4))
    matrix[..., :3, :3] = second_moments(phi)
    matrix[..., :3, 3] = matrix[..., 3, :3] = phi[..., 1:4]
    matrix[..., 3, 3] = phi[..., 0]
    return matrix


def phi_from_pseudo_inertia(matrix: FloatArray) -> FloatArray:
    """Return φ (..., 10) of pseudo-inertias (..., 4, 4)."""
    second = matrix[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    inertia = trace * np.eye(3) - second
    return np.concatenate(
        [matrix[..., 3, 3][..., None], matrix[..., :3, 3], inertia[..., _UPPER[0], _UPPER[1]]],
        axis=-1,
    )


def is_consistent(phi: FloatArray) -> bool:
    """Return whether some mass density realises φ (10,); all zeros are consistent.

    The tolerance for rounding of a degenerate body (a plate, a rod, a point mass) is ``_ROUNDING``
    of the pseudo-inertia with lengths in units of the body's size.
    """
    if not np.any(phi):
        return True
    matrix = pseudo_inertia(phi)
    diagonal = np.diag(matrix)
    if phi[0] <= 0 or np.any(diagonal[:3] < -_ROUNDING * diagonal[:3].max()):
        return False
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return bool(np.linalg.eigvalsh(matrix * np.outer(scale, scale))[0] > -_ROUNDING)


def nearest_consistent(phi: FloatArray) -> FloatArray:
    """Return the nearest φ (10,) that is physically consistent and that MuJoCo compiles.

    A consistent body changes by rounding at most, and one without mass gets ``TINY_MASS``. An
    inconsistent body with positive mass keeps mass and centre of mass; its negative central
    second moments become zero. Any other body is projected onto the cone of positive
    semi-definite pseudo-inertias.
    """
    mass, com, _ = com_from_phi(phi)
    if not np.any(phi):
        return phi_from_com(TINY_MASS, com, 1e-3 * TINY_MASS * np.eye(3))
    central = second_moments(phi) - mass * np.outer(com, com)
    if mass < LEAST_MASS or np.trace(central) < 0:
        phi = _projected(phi)
        mass, com, _ = com_from_phi(phi)
        if mass < LEAST_MASS:
            mass, com = TINY_MASS, np.zeros(3)
        central = second_moments(phi) - mass * np.outer(com, com)
    moments, axes = np.linalg.eigh(central)
    least = max(_LEAST_SECOND_MOMENT, _BOUNDARY * moments[-1])
    if mass == phi[0] and moments[0] >= least:
        return phi
    central = axes @ np.diag(np.maximum(moments, least)) @ axes.T
    return phi_from_com(mass, com, np.trace(central) * np.eye(3) - central)


def _projected(phi: FloatArray) -> FloatArray:
    """Return φ projected onto positive semi-definite pseudo-inertias, lengths in body sizes."""
    matrix = pseudo_inertia(phi)
    size = np.sqrt(abs(np.trace(matrix[:3, :3])) / max(abs(matrix[3, 3]), TINY_MASS))
    scale = np.array([1.0, 1.0, 1.0, np.clip(size, 0.01, 1.0)])
    values, axes = np.linalg.eigh(matrix * np.outer(scale, scale))
    nearest = axes @ np.diag(np.maximum(values, 0.0)) @ axes.T
    return phi_from_pseudo_inertia(nearest / np.outer(scale, scale))
