"""Credible intervals of predictions under a Gaussian posterior of the parameters."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, link_poses
from symbid_ros.dynamics.regressor import com_position, equation_of_motion
from symbid_ros.errors import EstimateError
from symbid_ros.identification.predictions.evaluation import TrueMotion, obeying_joints
from symbid_ros.model.parameters import ParameterSet

LEVEL = 0.9
# Half the width of the interval that holds LEVEL of a Gaussian, in standard deviations.
HALF_WIDTH = float(ndtri(0.5 + LEVEL / 2))


@dataclass(frozen=True)
class PredictionStd:
    """Standard deviations of an estimate's predictions along a motion.

    Attributes
    ----------
    com : (N, 3) float64
        Of the centre of mass in the base frame, m, to first order in the parameters.
    torque : (N, J) float64
        Of the torque that the motion needs with given contact forces (each joint's row of K φ), Nm
        or N.
    """

    com: FloatArray
    torque: FloatArray


@dataclass(frozen=True)
class IntervalSummary:
    """Width of the intervals, and how often they contain the truth.

    All samples of one motion share one estimate, so a single coverage can differ from ``LEVEL`` by
    chance. Its mean over many estimates equals ``LEVEL``.

    Attributes
    ----------
    com_std_mm, torque_std : float
        RMS over the samples of the norm of the standard deviations, mm and Nm.
    com_coverage, torque_coverage : float
        Share of samples and axes (or joints that do not stick) whose true value lies in the 90 %
        interval.
    """

    com_std_mm: float
    torque_std: float
    com_coverage: float
    torque_coverage: float


def prediction_std(
    parameters: ParameterSet, values: FloatArray, factor: FloatArray, motion: TrueMotion
) -> PredictionStd:
    """Return the standard deviations of predictions due to the parameters' covariance.

    Parameters
    ----------
    parameters : ParameterSet
        The robot and its columns.
    values : (p,) float64
        The estimate.
    factor : (p, r) float64
        L of the posterior covariance L Lᵀ.
    motion : TrueMotion

    Raises
    ------
    EstimateError
        When the factor has another number of parameters.
    """
    if factor.ndim != 2 or len(factor) != len(parameters):
        raise EstimateError(
            f"a covariance factor of shape {factor.shape} does not belong to the "
            f"{len(parameters)} parameters of {parameters.model.source}; give one row for each",
            "E523",
        )
    first_joint = 6 * parameters.model.floating
    com, torque = [], []
    for block in motion.blocks():
        poses = link_poses(parameters.model, block.samples.position)
        com.append(np.linalg.norm(_com_jacobian(parameters, values, poses) @ factor, axis=2))
        K = equation_of_motion(parameters, block.samples).K[:, first_joint:]
        torque.append(np.linalg.norm(K @ factor, axis=2))
    return PredictionStd(np.concatenate(com), np.concatenate(torque))


def summarise_intervals(
    parameters: ParameterSet,
    values: FloatArray,
    factor: FloatArray,
    truth: FloatArray,
    motion: TrueMotion,
) -> IntervalSummary:
    """Compare the credible intervals of an estimate with the truth.

    The true centre of mass follows from the true parameters (p,), the true torques from the
    forces of the motion, as in :func:`symbid_ros.identification.predictions.evaluation.evaluate`.
    """
    std = prediction_std(parameters, values, factor, motion)
    first_joint = 6 * parameters.model.floating
    com_error, torque_error, obeys = [], [], []
    for block in motion.blocks():
        poses = link_poses(parameters.model, block.samples.position)
        found, true = (com_position(parameters, phi, poses) for phi in (values, truth))
        com_error.append(found - true)
        rows = equation_of_motion(parameters, block.samples)
        torque_error.append((rows.K @ values - rows.y)[:, first_joint:])
        obeys.append(obeying_joints(parameters, truth, block.samples.velocity))
    used = np.concatenate(obeys)
    return IntervalSummary(
        com_std_mm=1e3 * _rms(std.com),
        torque_std=_rms(std.torque),
        com_coverage=_coverage(np.concatenate(com_error), std.com),
        torque_coverage=_coverage(np.concatenate(torque_error)[used], std.torque[used]),
    )


def _com_jacobian(parameters: ParameterSet, values: FloatArray, poses: LinkPoses) -> FloatArray:
    """Return the derivative (N, 3, p) of Σ (m p + R mc) / Σ m with respect to the parameters."""
    com = com_position(parameters, values, poses)
    jacobian = np.zeros((len(com), 3, len(parameters)))
    for index, link in enumerate(parameters.links):
        first = 10 * index
        jacobian[:, :, first] = poses.position[:, link] - com
        jacobian[:, :, first + 1 : first + 4] = poses.rotation[:, link]
    jacobian /= parameters.link_phi(values)[:, 0].sum()
    return jacobian


def _rms(deviation: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(deviation**2, axis=1))))


def _coverage(error: FloatArray, std: FloatArray) -> float:
    return float(np.mean(np.abs(error) <= HALF_WIDTH * std)) if error.size else 0.0
