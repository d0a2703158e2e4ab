"""Predictions that a controller could make on the robot, from noisy sensors (thesis, chapter 4)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import FloatArray, concatenated
from symbid_ros.dynamics.contact import contact_jacobian, contact_wrenches
from symbid_ros.dynamics.imu import BaseMotion, base_motion
from symbid_ros.dynamics.kinematics import link_poses, rotate
from symbid_ros.dynamics.regressor import (
    centroidal,
    com_position,
    equation_of_motion,
    known_force,
    momentum_regressor,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import BagError, DataError
from symbid_ros.identification.predictions.evaluation import (
    SAMPLES_AT_ONCE,
    TrueMotion,
    obeying_joints,
    predict,
    true_motion,
)
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import align
from symbid_ros.signals.filters import CausalLowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.streams import Streams, TruthStreams

# Relative singular value of the contact Jacobian below which a combination of wrenches is set to
# zero, because its noise would exceed it. With the legs in parallel planes, feet that twist against
# each other reach 1e-3; all other combinations of two feet and an overhead
# support exceed 1e-2.
SINGULAR = 3e-3


@dataclass(frozen=True)
class RealisticMotion:
    """A noisy log as a controller on the robot has it, and the truth.

    Attributes
    ----------
    measured : Samples
        Positions and wrenches as measured. Velocities, including the base's angular velocity, are
        filtered causally. Efforts are those measured one period *before* (f_aⁱ of Eq. 4.1), which
        is inaccurate if the motors vibrate at hundreds of hertz. Accelerations and specific force
        are the true ones and represent the ideal desired motion.
    truth : TrueMotion
        At the same instants. Predictions also use its linear velocity and orientation of the base,
        as from an ideal state estimator, because no sensor measures them.
    """

    measured: Samples
    truth: TrueMotion


@dataclass(frozen=True)
class RealisticPrediction:
    """Predictions of one parameter vector for a noisy log.

    Attributes
    ----------
    wrenches : (N, F, 6) float64
        Contact wrenches of Eq. 4.1 (moment; force) about the origin of each frame, in its axes.
    torque : (N, J) float64
        Joint torques for the desired accelerations, given these contact wrenches.
    torque_from_wrenches : (N, J) float64
        Joint torques given the measured wrenches.
    com : (N, 3) float64
        Centre of mass in the base frame, m.
    momentum : (N, 6) float64
        Angular about the model's own centre of mass (Nms), then linear (Ns), in world axes.
    """

    wrenches: FloatArray
    torque: FloatArray
    torque_from_wrenches: FloatArray
    com: FloatArray
    momentum: FloatArray


@dataclass(frozen=True)
class RealisticMetrics:
    """RMSE of realistic predictions in Nm, N, Nm, mm, and Ns with Nms.

    The error of a vector is its norm at each sample. Torques are compared with the true ones where
    :func:`~symbid_ros.identification.predictions.evaluation.obeying_joints` is true;
    contact forces and moments with the measured wrenches, whose noise adds to the error; centre of
    mass and momentum with those of the true model along the true motion.
    """

    torque_rmse: float
    torque_from_wrenches_rmse: float
    contact_force_rmse: float
    contact_moment_rmse: float
    com_position_rmse_mm: float
    com_momentum_rmse: float


def realistic_motion(
    recorded: TruthStreams,
    streams: Streams,
    model: RobotModel,
    low_pass: CausalLowPass | None = None,
    internal: Collection[str] = (),
) -> RealisticMotion:
    """Return a noisy simulated log with filtered velocities, and its ground truth.

    ``internal`` names the frames of wrist sensors.

    Raises
    ------
    BagError
        When ground truth and joint states have no common stamp.
    DataError
        When a floating robot's log has no IMU.
    """
    streams = streams.without_wrenches(internal)
    truth = true_motion(recorded, streams, model)
    if model.floating and not streams.imus:
        raise DataError(
            f"{streams.source}: the base of {model.source} floats, but the bag has no "
            "sensor_msgs/msg/Imu topic; record the IMU, or give `base` fixed if it is bolted down",
            "E524",
        )
    low_pass = low_pass or CausalLowPass()
    filtered = [_filtered(segment, streams, model, low_pass) for segment in align(streams, model)]
    measured = {name: np.concatenate([part[name] for part in filtered]) for name in filtered[0]}
    stamp = measured.pop("stamp")
    common, here, there = np.intersect1d(stamp, truth.samples.stamp, return_indices=True)
    if len(common) == 0:
        raise BagError(
            f"{streams.source}: ground truth and {streams.joints.topic} share no stamp once the "
            "velocity filter has settled; use a longer bag of `symbid simulate`",
            "E525",
        )
    true = truth[there]
    at_common: dict[str, Any] = {name: values[here] for name, values in measured.items()}
    return RealisticMotion(replace(true.samples, **at_common), true)


def _filtered(
    segment: Segment, streams: Streams, model: RobotModel, low_pass: CausalLowPass
) -> dict[str, NDArray[Any]]:
    """Return the measured fields of a :class:`RealisticMotion`, and their stamps (N,)."""
    velocity = low_pass.velocity(segment.position, segment.rate)
    edge = max(1, low_pass.settling(segment.rate))
    return {
        "stamp": segment.stamp[edge:],
        "position": segment.position[edge:],
        "velocity": velocity[edge:],
        "effort": np.nan_to_num(segment.effort[edge - 1 : -1]),  # of the period before
        "base_angular_velocity": _base_rate(segment, streams, model, low_pass, velocity)[edge:],
    }


def _base_rate(
    segment: Segment,
    streams: Streams,
    model: RobotModel,
    low_pass: CausalLowPass,
    velocity: FloatArray,
) -> FloatArray:
    """Return the base's angular velocity (M, 3), averaged over the IMUs."""
    unused = np.zeros((len(segment.stamp), 3))
    if not model.floating:
        return unused
    joints = segment.position, velocity, np.zeros_like(velocity)
    rates = [
        base_motion(
            model,
            imu.frame_id,
            joints,
            BaseMotion(low_pass(segment.angular_velocity[:, index], segment.rate), unused, unused),
        ).angular_velocity
        for index, imu in enumerate(streams.imus)
    ]
    mean: FloatArray = np.mean(rates, axis=0)
    return mean


def predict_realistic(
    parameters: ParameterSet, values: FloatArray, motion: RealisticMotion
) -> RealisticPrediction:
    """Return the predictions of the parameters (p,) for the log."""
    return concatenated([_predictions(parameters, [values], block)[0] for block in _blocks(motion)])


def evaluate_realistic(
    parameters: ParameterSet,
    candidates: Mapping[str, FloatArray],
    truth: FloatArray,
    motion: RealisticMotion,
) -> dict[str, RealisticMetrics]:
    """Return the metrics of several parameter vectors (p,); ``truth`` (p,) is the true one."""
    squares, counts = np.zeros((len(candidates), len(fields(RealisticMetrics)))), 0
    for block in _blocks(motion):
        true = predict(parameters, truth, block.truth)
        effort, wrenches = block.truth.samples.effort, block.measured.wrenches
        obeys = obeying_joints(parameters, truth, block.truth.samples.velocity)
        counts += int(obeys.any(axis=1).sum())
        for row, predicted in zip(
            squares, _predictions(parameters, [*candidates.values()], block), strict=True
        ):
            contact = predicted.wrenches - wrenches
            errors = (
                (predicted.torque - effort) * obeys,
                (predicted.torque_from_wrenches - effort) * obeys,
                contact[..., 3:],
                contact[..., :3],
                1e3 * (predicted.com - true.com),
                predicted.momentum - true.momentum,
            )
            row += [np.sum(error**2) for error in errors]
    samples = np.full(squares.shape[1], len(motion.measured))
    samples[:2] = max(counts, 1)
    roots = np.sqrt(squares / samples)
    return {
        label: RealisticMetrics(*row.tolist()) for label, row in zip(candidates, roots, strict=True)
    }


def _blocks(motion: RealisticMotion) -> list[RealisticMotion]:
    return [
        RealisticMotion(measured, truth)
        for measured, truth in zip(
            motion.measured.blocks(SAMPLES_AT_ONCE), motion.truth.blocks(), strict=True
        )
    ]


def _predictions(
    parameters: ParameterSet, candidates: Sequence[FloatArray], motion: RealisticMotion
) -> list[RealisticPrediction]:
    """Return the predictions of all candidates for one block; shared matrices are computed once."""
    model, samples, truth = parameters.model, motion.measured, motion.truth
    first_joint = 6 * model.floating
    poses = link_poses(model, samples.position)
    jacobian = contact_jacobian(model, samples.wrench_frames, poses)
    momentum = momentum_regressor(parameters, samples, truth.base_velocity, poses)
    needed = np.stack(candidates) @ equation_of_motion(parameters, samples).K.transpose(0, 2, 1)
    needed += known_force(parameters, samples)[:, None]
    unmet = needed.copy()
    unmet[:, :, first_joint:] -= samples.effort[:, None]
    wrenches = contact_wrenches(jacobian, unmet, SINGULAR)
    stacked = wrenches.reshape(*needed.shape[:2], jacobian.shape[1])
    given = samples.wrenches.reshape(len(samples), 1, jacobian.shape[1])
    torque = (needed - stacked @ jacobian)[:, :, first_joint:]
    from_measured = (needed - given @ jacobian)[:, :, first_joint:]
    predictions = []
    for index, values in enumerate(candidates):
        com = com_position(parameters, values, poses)
        about_com = centroidal(momentum @ values, com).reshape(-1, 2, 3)
        predictions.append(
            RealisticPrediction(
                wrenches=wrenches[:, index],
                torque=torque[:, index],
                torque_from_wrenches=from_measured[:, index],
                com=com,
                momentum=rotate(truth.base_rotation[:, None], about_com).reshape(-1, 6),
            )
        )
    return predictions
