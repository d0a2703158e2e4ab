"""Comparison of an estimate with the ground truth of a simulation, as in the thesis."""

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, concatenated
from symbid_ros.choices import SLIDING_TERMS
from symbid_ros.dynamics.friction import slipping
from symbid_ros.dynamics.inertial_rows import generalised_force
from symbid_ros.dynamics.kinematics import joint_axes, link_poses, rotate, rotate_inverse
from symbid_ros.dynamics.regressor import (
    equation_of_motion,
    first_moment_regressor,
    known_force,
    momentum_regressor,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import BagError
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import rotation_from_xyzw
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import joint_columns
from symbid_ros.signals.streams import Streams, TruthStreams

logger = logging.getLogger(__name__)

SAMPLES_AT_ONCE = 1024  # samples whose rows are in memory at a time
# Of the forces, RMS, what a true robot may leave: integration of friction leaves 0.00005, inertias
# that are wrong by 1 % leave 0.004.
UNEXPLAINED = 0.002
# A correlation beyond this many standard deviations of that of white noise is not due to noise.
SIGNIFICANT = 5.0


@dataclass(frozen=True)
class TrueMotion:
    """The true motion and forces of a simulated log.

    Attributes
    ----------
    samples : Samples
        True joint and base motion, true efforts, and measured wrenches.
    base_velocity : (N, 3) float64
        Linear velocity of the base's origin in base axes, m/s.
    base_rotation : (N, 3, 3) float64
        From base axes to world axes.
    """

    samples: Samples
    base_velocity: FloatArray
    base_rotation: FloatArray

    def __getitem__(self, index: slice | IntArray) -> "TrueMotion":
        """Return the motion at ``index``, a slice or indices."""
        return TrueMotion(self.samples[index], self.base_velocity[index], self.base_rotation[index])

    def blocks(self) -> Iterator["TrueMotion"]:
        """Yield consecutive parts of the motion."""
        for start in range(0, len(self.samples), SAMPLES_AT_ONCE):
            yield self[start : start + SAMPLES_AT_ONCE]


@dataclass(frozen=True)
class MotionPrediction:
    """Predictions of one parameter vector along a true motion.

    Attributes
    ----------
    gen_force : (N, n) float64
        K φ with the known joint terms, Nm and N.
    com : (N, 3) float64
        Centre of mass in the base frame, m.
    momentum : (N, 6) float64
        Angular about the model's own centre of mass (Nms), then linear (Ns), in
        world axes.
    """

    gen_force: FloatArray
    com: FloatArray
    momentum: FloatArray


@dataclass(frozen=True)
class Metrics:
    """The thesis's five attributes (section IV-B); a vector's error is its norm per sample.

    Generalised forces and torques are compared where :func:`obeying_joints` is true.

    Attributes
    ----------
    gen_force_rmse, torque_rmse : float
        All coordinates (Nm and N), and the joints alone (Nm, or N of prismatic joints).
    com_position_rmse_mm : float
        Centre of mass in the base's frame, mm.
    com_momentum_rmse : float
        Centroidal momentum, angular (Nms) and linear (Ns).
    parameter_error_pct : float
        Mean of the relative errors of the inertial parameters, %.
    """

    gen_force_rmse: float
    torque_rmse: float
    com_position_rmse_mm: float
    com_momentum_rmse: float
    parameter_error_pct: float


def true_motion(
    truth: TruthStreams, streams: Streams, model: RobotModel, internal: Collection[str] = ()
) -> TrueMotion:
    """Return the true motion at the stamps that ground truth and all wrenches have in common.

    Parameters
    ----------
    truth : TruthStreams
    streams : Streams
        Sensors of the same log.
    model : RobotModel
        The true robot, without wrist sensors.
    internal : collection of str
        Frames of wrist sensors, whose wrenches are forces inside of the robot.

    Raises
    ------
    BagError
        When there is no common stamp.
    """
    streams = streams.without_wrenches(internal)
    common = truth.stamp
    for wrench in streams.wrenches:
        common = np.intersect1d(common, wrench.stamp)
    if len(common) == 0:
        raise BagError(
            f"{truth.source}: ground truth and wrenches share no stamp; record both", "E525"
        )
    return _at(truth, streams, common, model)


def check_true_robot(robot: RobotModel, motion: TrueMotion) -> None:
    """Log a warning if a robot is not the one whose motion and forces were simulated, exactly.

    The true robot's residuals are the noise of the wrench sensors, which is white. Residuals that
    are correlated from sample to sample come from another model, a payload or sensor errors.
    """
    parameters = ParameterSet(robot)
    first_joint = 6 * robot.floating
    squares, products, sizes = np.zeros((3, robot.dof))
    for block in motion.blocks():
        rows = equation_of_motion(parameters, block.samples)
        residual = rows.K @ parameters.values - rows.y
        residual[:, first_joint:] *= obeying_joints(
            parameters, parameters.values, block.samples.velocity
        )
        squares += np.sum(residual**2, axis=0)
        products += np.sum(residual[1:] * residual[:-1], axis=0)
        sizes += np.sum(rows.y**2, axis=0)
    shares, noise = [], []
    # The forces on a base exceed those of the joints many times over.
    for rows_of in (slice(None), slice(first_joint, None)):
        square, product, size = (one[rows_of].sum() for one in (squares, products, sizes))
        if product * np.sqrt(len(motion.samples)) > SIGNIFICANT * square:
            shares.append(np.sqrt(product / size))
        noise.append(np.sqrt(square / max(size, np.finfo(float).tiny)))
    if max(shares, default=0.0) > UNEXPLAINED:
        logger.warning(
            "%s leaves %.2g %% of the bag's forces unexplained, so it is not the true robot, or "
            "the bag has a payload or sensor errors; give the simulated robot (`symbid simulate "
            "--true-model` writes it) and a bag of `symbid simulate --ideal`",
            robot.source,
            100 * max(shares),
        )
    elif max(noise) > UNEXPLAINED:
        logger.warning(
            "the wrenches of the bag are noisy, by %.2g %% of the forces; errors and intervals of "
            "forces and torques contain this noise: give a bag of `symbid simulate --ideal`, and "
            "noisy ones as `realistic`",
            100 * max(noise),
        )


def _at(truth: TruthStreams, streams: Streams, stamp: IntArray, model: RobotModel) -> TrueMotion:
    """Return the motion at stamps that every stream has."""
    rows = np.searchsorted(truth.stamp, stamp)
    columns = joint_columns(truth.joint_names, model, f"{truth.source}: ground_truth/joints")
    effort = truth.effort[np.ix_(rows, columns)]
    effort[:, list(model.followers)] = 0.0
    wrenches = [
        np.concatenate([wrench.torque, wrench.force], axis=1)[np.searchsorted(wrench.stamp, stamp)]
        for wrench in streams.wrenches
    ]
    rotation = rotation_from_xyzw(truth.base_orientation[rows])
    gravity = rotate_inverse(rotation, model.gravity) if model.floating else model.gravity
    samples = Samples(
        stamp=stamp,
        position=model.apply_mimics(truth.position[np.ix_(rows, columns)]),
        velocity=model.apply_mimics(truth.velocity[np.ix_(rows, columns)], rates=True),
        acceleration=model.apply_mimics(truth.acceleration[np.ix_(rows, columns)], rates=True),
        effort=effort,
        base_angular_velocity=truth.base_angular_velocity[rows],
        base_angular_acceleration=truth.base_angular_acceleration[rows],
        base_specific_force=truth.base_linear_acceleration[rows] - gravity,
        wrenches=np.stack(wrenches, axis=1) if wrenches else np.zeros((len(stamp), 0, 6)),
        wrench_frames=tuple(wrench.frame_id for wrench in streams.wrenches),
    )
    return TrueMotion(samples, truth.base_linear_velocity[rows], rotation)


def predict(parameters: ParameterSet, values: FloatArray, motion: TrueMotion) -> MotionPrediction:
    """Return the predictions of the parameters (p,) along the motion."""
    parts = []
    for block in motion.blocks():
        gen_force, com, momentum = _LinearPrediction.of(parameters, values, block).predict(
            values[:, None]
        )
        about_com = momentum[..., 0].reshape(-1, 2, 3)
        in_world = rotate(block.base_rotation[:, None], about_com).reshape(-1, 6)
        parts.append(MotionPrediction(gen_force[..., 0], com[..., 0], in_world))
    return concatenated(parts)


def evaluate(
    parameters: ParameterSet,
    candidates: Mapping[str, FloatArray],
    truth: FloatArray,
    motion: TrueMotion,
) -> dict[str, Metrics]:
    """Return the five metrics of several parameter vectors (p,) against the true one (p,).

    Forces are compared with measured ones, everything else with the true model.
    """
    blocks = (_LinearPrediction.of(parameters, truth, block) for block in motion.blocks())
    return _metrics(parameters, candidates, truth, blocks)


def obeying_joints(parameters: ParameterSet, truth: FloatArray, velocity: FloatArray) -> BoolArray:
    """Return which joints (N, J) obey the true robot's equation of motion at rates (N, J).

    The friction of a joint at rest takes any value up to its Coulomb friction, so no model predicts
    its effort.
    """
    has_friction = np.zeros(velocity.shape[1], dtype=bool)
    for term, columns in parameters.term_columns.items():
        if term in SLIDING_TERMS:
            has_friction[parameters.joints] |= truth[columns] != 0
    for term, values in parameters.known_terms.items():
        if term in SLIDING_TERMS:
            has_friction |= values != 0
    return np.asarray(slipping(parameters, velocity) | ~has_friction)


def sticking_share(parameters: ParameterSet, truth: FloatArray, motion: TrueMotion) -> float:
    """Return the share of the joints' instants that metrics of forces leave out."""
    moving = list(parameters.joints)
    if not moving:
        return 0.0
    obeys = obeying_joints(parameters, truth, motion.samples.velocity)[:, moving]
    return float(1 - obeys.mean())


class MotionEvaluator:
    """Evaluates many candidates along one motion; matrices are computed once.

    Parameters
    ----------
    parameters : ParameterSet
        The p columns.
    truth : (p,) float64
        The true parameters.
    motion : TrueMotion
        Short enough for memory: 20 kB for each sample with ten joints.
    """

    def __init__(self, parameters: ParameterSet, truth: FloatArray, motion: TrueMotion) -> None:
        self._parameters, self._truth = parameters, truth
        self._blocks = [_LinearPrediction.of(parameters, truth, block) for block in motion.blocks()]

    def metrics(self, candidates: Mapping[str, FloatArray]) -> dict[str, Metrics]:
        """Return the five metrics, as :func:`evaluate` does."""
        return _metrics(self._parameters, candidates, self._truth, self._blocks)


def _metrics(
    parameters: ParameterSet,
    candidates: Mapping[str, FloatArray],
    truth: FloatArray,
    blocks: Iterable["_LinearPrediction"],
) -> dict[str, Metrics]:
    first_joint = 6 * parameters.model.floating
    stacked = np.stack([truth, *candidates.values()], axis=1)
    squares, samples = np.zeros((4, len(candidates))), np.zeros((4, 1))
    for block in blocks:
        gen_force, com, momentum = block.predict(stacked)
        force = (gen_force[..., 1:] - block.y[..., None]) * block.obeys[..., None]
        errors = (
            force,
            force[:, first_joint:],
            1e3 * (com[..., 1:] - com[..., :1]),
            momentum[..., 1:] - momentum[..., :1],
        )
        squares += [np.sum(error**2, axis=(0, 1)) for error in errors]
        forces, torques = (
            int(block.obeys[:, first:].any(axis=1).sum()) for first in (0, first_joint)
        )
        samples[:, 0] += [forces, torques, len(block.y), len(block.y)]
    roots = np.sqrt(squares / np.maximum(samples, 1))
    metrics = {}
    for column, (label, values) in enumerate(candidates.items()):
        force, torque, com, momentum = roots[:, column].tolist()
        error = parameter_error(parameters, values, truth)
        metrics[label] = Metrics(force, torque, com, momentum, error)
    return metrics


@dataclass(frozen=True)
class _LinearPrediction:
    """Matrices of the predictions for a part of a true motion, linear in the parameters.

    Attributes
    ----------
    matrix : (N, n + 9, p) float64
        Onto generalised force, momentum about the base's origin (angular; linear) and first
        moment, base axes.
    y : (N, n) float64
        Measured generalised force.
    known : (N, n) float64
        Force of known friction and armature.
    mass : (p,) float64
        1 for each mass, 0 for other parameters.
    obeys : (N, n) bool
        False at joints that may stick.
    """

    matrix: FloatArray
    y: FloatArray
    known: FloatArray
    mass: FloatArray
    obeys: BoolArray

    @classmethod
    def of(
        cls, parameters: ParameterSet, truth: FloatArray, motion: TrueMotion
    ) -> "_LinearPrediction":
        rows = equation_of_motion(parameters, motion.samples)
        poses = link_poses(parameters.model, motion.samples.position)
        momentum = momentum_regressor(parameters, motion.samples, motion.base_velocity, poses)
        matrix = np.concatenate(
            [rows.K, momentum, first_moment_regressor(parameters, poses)], axis=1
        )
        mass = np.zeros(len(parameters))
        mass[: parameters.inertial : 10] = 1.0
        known = known_force(parameters, motion.samples)
        obeys = np.ones(rows.y.shape, dtype=bool)
        first_joint = 6 * parameters.model.floating
        obeys[:, first_joint:] = obeying_joints(parameters, truth, motion.samples.velocity)
        return cls(matrix, rows.y + known, known, mass, obeys)

    def predict(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return generalised force (N, n, c), centre of mass (N, 3, c), momentum (N, 6, c).

        For each column of ``values`` (p, c), in base axes; angular momentum about the centre of
        mass of that column.
        """
        n = self.y.shape[1]
        count, _, p = self.matrix.shape
        flat = self.matrix.reshape(-1, p) @ values
        found = flat.reshape(count, n + 9, values.shape[1])
        com = found[:, n + 6 :] / (self.mass @ values)
        momentum = found[:, n : n + 6].copy()
        momentum[:, :3] -= np.cross(com, momentum[:, 3:], axis=1)
        return found[:, :n] + self.known[..., None], com, momentum


def parameter_error(parameters: ParameterSet, values: FloatArray, truth: FloatArray) -> float:
    """Return the mean of |φ̂ - φ|/|φ| in % over the inertial parameters with φ ≠ 0."""
    count = parameters.inertial
    used = truth[:count] != 0
    error = np.abs(values[:count] - truth[:count])[used] / np.abs(truth[:count])[used]
    return float(100 * error.mean())


def link_errors(parameters: ParameterSet, values: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the mean relative error of each link (len(links),) in %, as in the thesis, Fig. 6."""
    estimated, true = parameters.link_phi(values), parameters.link_phi(truth)
    used = true != 0
    error = np.divide(np.abs(estimated - true), np.abs(true), out=np.zeros(true.shape), where=used)
    counted = used.sum(axis=1)
    percent: FloatArray = np.full(len(true), np.nan)
    percent[counted > 0] = 100 * error.sum(axis=1)[counted > 0] / counted[counted > 0]
    return percent


def environment_force(model: RobotModel, motion: TrueMotion) -> FloatArray:
    """Return J_gᵀ f_e (N, n), the generalised force of the measured wrenches."""
    samples = replace(motion.samples, effort=np.zeros_like(motion.samples.effort))
    poses = link_poses(model, samples.position)
    return generalised_force(model, samples, poses, joint_axes(model, poses))
