"""A live estimate as a model for a controller, and what it knows of the whole robot."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.report.robot_summary import summarise_robot


@dataclass(frozen=True)
class RobotUncertainty:
    """Mass of a whole robot, and the deviations of its mass and centre of mass.

    Attributes
    ----------
    time : float
        Stamp of the newest data, s.
    mass, mass_std : float
        kg.
    com_std : float
        Root sum square of the coordinates' deviations in one posture, m.
    """

    time: float
    mass: float
    mass_std: float
    com_std: float


def robot_uncertainty(
    estimate: OnlineEstimate, posture: FloatArray | None
) -> RobotUncertainty | None:
    """Return what an estimate knows of the whole robot; None if its method gives no covariance.

    Parameters
    ----------
    estimate : OnlineEstimate
    posture : (J,) float64 or None
        Joint positions; None for zeros.
    """
    found, factor = estimate.found.estimate, estimate.found.deviation_factor
    if factor is None:
        return None
    summary = summarise_robot(estimate.parameters, found.value, found.prior, factor, posture)
    return RobotUncertainty(
        estimate.until * 1e-9,
        summary.mass,
        summary.mass_std,
        float(np.linalg.norm(summary.com_std)),
    )


def candidate_model(estimate: OnlineEstimate, known: RobotUncertainty) -> CandidateModel:
    """Return an estimate with standard deviations as a model for a controller."""
    found, parameters = estimate.found.estimate, estimate.parameters
    assert found.std is not None
    count = parameters.inertial
    change = estimate.change
    return CandidateModel(
        parameters.link_names,
        found.value[:count].reshape(-1, 10),
        found.std[:count].reshape(-1, 10),
        estimate.alarms,
        mass_std=known.mass_std,
        com_std=known.com_std,
        change="" if change is None else str(change),
    )
