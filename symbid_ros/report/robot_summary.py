"""Mass and centre of mass of a whole robot and of its links, with standard deviations."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.model.parameters import ParameterSet


@dataclass(frozen=True)
class RobotSummary:
    """Mass and centre of mass, before and after an identification.

    Attributes
    ----------
    is_floating : bool
        Whether the base floats. The base of a fixed robot is left out, as no sensor feels it.
    mass, mass_std, mass_before : float
        kg; the deviation is NaN if the method gives none.
    is_mass_measured : bool or None
        Whether the mass has less than half of the variance that the model file's has; None if
        that is unknown.
    has_mass_moved : bool
        Whether the mass differs from the model file's by more than the deviation of the latter.
    com, com_std, com_before : (3,) float64
        Centre of mass in the base frame, m.
    posture : (J,) float64
        Joint positions, rad or m.
    is_mean_posture : bool
        Whether this is the mean posture of the log; otherwise all positions are zero.
    link_com_std : dict of str to float
        For each link the RMS over the axes of its centre of mass's standard deviation, m.
    """

    is_floating: bool
    mass: float
    mass_std: float
    mass_before: float
    is_mass_measured: bool | None
    has_mass_moved: bool
    com: FloatArray
    com_std: FloatArray
    com_before: FloatArray
    posture: FloatArray
    is_mean_posture: bool
    link_com_std: dict[str, float]


def summarise_robot(
    parameters: ParameterSet,
    value: FloatArray,
    prior: FloatArray,
    deviations: FloatArray | None,
    posture: FloatArray | None,
    *,
    prior_std: FloatArray | None = None,
) -> RobotSummary:
    """Return the mass and the centre of mass of a robot.

    Parameters
    ----------
    parameters : ParameterSet
        The p parameters.
    value, prior : (p,) float64
        Identified and original parameters.
    deviations : (p, r) float64 or None
        L of the covariance L Lᵀ; None if there is none.
    posture : (J,) float64 or None
        Joint positions; None for zeros.
    prior_std : (p,) float64, optional
        Standard deviations of the original parameters; those of masses are independent.
    """
    model = parameters.model
    joints = np.zeros(len(model.joints)) if posture is None else posture
    poses = link_poses(model, joints[None])
    rotation, origin = poses.rotation[0][parameters.links], poses.position[0][parameters.links]
    count = len(parameters.links)
    counted = np.ones(count, dtype=bool)
    if not model.floating and count > 1:
        counted[parameters.links == 0] = False

    def moments(values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        phi = values[: parameters.inertial].reshape(count, 10)
        mass = phi[:, 0] * counted
        first = np.einsum("lij,lj->li", rotation, phi[:, 1:4]) * counted[:, None]
        total = float(mass.sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            com = (first + mass[:, None] * origin).sum(axis=0) / total
        return total, np.asarray(com), phi

    mass, com, phi = moments(value)
    mass_before, com_before, _ = moments(prior)
    mass_std, com_std, link_com_std = np.nan, np.full(3, np.nan), dict[str, float]()
    if deviations is not None:
        factor = deviations[: parameters.inertial].reshape(count, 10, -1)
        masses = factor[:, 0] * counted[:, None]
        mass_std = float(np.linalg.norm(masses.sum(axis=0)))
        first = np.einsum("lij,ljr->lir", rotation, factor[:, 1:4]) * counted[:, None, None]
        lever = origin - com
        change = (first + lever[:, :, None] * masses[:, None, :]).sum(axis=0) / mass
        com_std = np.linalg.norm(change, axis=1)
        own = phi[:, 1:4] / phi[:, :1]
        of_links = (factor[:, 1:4] - own[:, :, None] * factor[:, :1]) / phi[:, :1, None]
        rms = np.sqrt(np.mean(np.sum(of_links**2, axis=2), axis=1))
        link_com_std = dict(zip(parameters.link_names, rms.tolist(), strict=True))
    is_mass_measured, has_mass_moved = None, False
    if prior_std is not None and np.isfinite(mass_std):
        variance = float(np.sum(prior_std[: parameters.inertial : 10][counted] ** 2))
        is_mass_measured = bool(mass_std**2 < DETERMINED**2 * variance)
        has_mass_moved = bool((mass - mass_before) ** 2 > variance)
    return RobotSummary(
        is_floating=model.floating,
        mass=mass,
        mass_std=mass_std,
        mass_before=mass_before,
        is_mass_measured=is_mass_measured,
        has_mass_moved=has_mass_moved,
        com=com,
        com_std=com_std,
        com_before=com_before,
        posture=joints,
        is_mean_posture=posture is not None,
        link_com_std=link_com_std,
    )
