"""Rows of the equation of motion with the sensors' errors as further unknowns."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, concatenated
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.placements import displaced, displacement_columns
from symbid_ros.dynamics.regressor import Rows, equation_of_motion, equation_residual
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import without_contacts
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sampled_rows import SampledRows, rows_that_hold, samples_at_once
from symbid_ros.signals.sensor_drift import SensorDrift
from symbid_ros.signals.sensor_errors import (
    AXIS,
    COMPLIANCE,
    DELAY,
    DRIVE_GAIN,
    FRAME,
    LENGTH,
    PLACE,
    SensorErrors,
    left_jacobian,
)
from symbid_ros.signals.sensor_samples import SensorSamples, at_base

# The columns change as slowly as the robot moves: they are computed with this period and
# interpolated.
COLUMN_PERIOD_NS = 20_000_000
CHUNK = 4096
STEP = 1e-4  # of a finite difference, rad, rad/s or m/s²; of deflections at the largest effort
TIME_STEP = 1e-5  # of a finite difference, s
# Kinds of errors whose columns are generalised forces, as the efforts and wrenches themselves are.
FORCE_ERRORS = "torque_gain", "wrench_"


@dataclass(frozen=True)
class LinearizationPoint:
    """Point at which the rows are linearized: φ₀ (p,) and θ₀ (r,)."""

    phi: FloatArray
    theta: FloatArray


def error_columns(
    parameters: ParameterSet,
    errors: SensorErrors,
    linearization: LinearizationPoint,
    readings: SensorSamples,
) -> FloatArray:
    """Return C = ∂(y - K φ)/∂θ (N, n, r) at the linearization point."""
    theta = linearization.theta
    nominal, parameters = parameters.model, errors.placed(parameters, theta)
    model = parameters.model
    # Rows of joints whose effort was not measured are masked, but a NaN would not be.
    readings = replace(readings, effort=np.nan_to_num(readings.effort))

    def residuals(
        at: Sequence[FloatArray],
        parameters: ParameterSet = parameters,
        phi: FloatArray = linearization.phi,
        seen_by_imus: RobotModel = model,
    ) -> FloatArray:
        """Return the residuals (S, N, n) at some θ, all in one evaluation, as blocks are short."""
        corrected = concatenated([errors.corrected(readings, one) for one in at])
        found = equation_residual(parameters, at_base(corrected, seen_by_imus), phi)
        return found.reshape(len(at), len(readings), -1)

    C = np.zeros((len(readings), model.dof, len(errors)))
    columns: list[int] = []
    steps: list[float] = []
    for kind, place in errors.places.items():
        if kind in ("imu_mounting", "imu_bias", "encoder_offset", DELAY, FRAME):
            # The rotations of wrench sensors are linear in the wrenches.
            linear = 3 * len(errors.wrench_frames) if kind == FRAME else 0
            columns += range(place.start + linear, place.stop)
            steps += [TIME_STEP if kind == DELAY else STEP] * (place.stop - place.start - linear)
    unshifted, *shifted = residuals([theta, *_shifted(theta, columns, steps)])
    for column, step, one in zip(columns, steps, shifted, strict=True):
        C[:, :, column] = (one - unshifted) / step
    for kind, place in errors.places.items():
        if kind == COMPLIANCE:
            # Links move behind the gears. Friction and rotors move with the motors.
            bare = parameters.with_known_values({})
            phi = linearization.phi.copy()
            phi[parameters.inertial :] = 0.0
            step = STEP / max(float(np.abs(readings.effort).max()), 1.0)
            columns = list(range(place.start, place.stop))
            moved = _shifted(theta, columns, [step] * len(columns))
            rigid, *bent = residuals([theta, *moved], bare, phi)
            for column, one in zip(columns, bent, strict=True):
                C[:, :, column] = (one - rigid) / step
        elif kind == "torque_gain":
            rows = 6 * model.floating + np.flatnonzero(errors.driven)
            gain = errors.of_kind(kind, theta)[:, 0]
            effort = errors.realigned(readings, theta).effort[:, errors.driven]
            C[:, rows, range(place.start, place.stop)] = -np.nan_to_num(effort) / (1 + gain) ** 2
    _fill_plates(C, errors, model, readings, theta)
    is_force = [name.rpartition("/")[2].startswith(FORCE_ERRORS) for name in errors.names]
    if model.contacts is not None and any(is_force):
        samples = at_base(errors.corrected(readings, theta), model)
        C[:, :, is_force] = without_contacts(model, samples, C[:, :, is_force])
    if LENGTH in errors.kinds or AXIS in errors.kinds:
        corrected = errors.corrected(readings, theta)
        phi = _carried_phi(parameters, linearization.phi, readings.stamp)
        by_screws = displacement_columns(model, phi, at_base(corrected, model))
        # Displaced joints between the base and an IMU change the base's motion.
        for joint in np.flatnonzero(_carries_imu(errors, model)):
            for axis in range(6):
                screws = np.zeros((len(model.joints), 6))
                screws[joint, axis] = STEP
                (moved,) = residuals([theta], seen_by_imus=displaced(model, screws))
                by_screws[:, :, joint, axis] += (moved - unshifted) / STEP
        errors.fill_placements(C, by_screws, nominal, theta)
    if PLACE in errors.kinds:
        K = equation_of_motion(parameters, at_base(errors.corrected(readings, theta), model)).K
        errors.fill_payloads(C, K, parameters, readings.stamp)
    return C


def _shifted(theta: FloatArray, columns: Sequence[int], steps: Sequence[float]) -> list[FloatArray]:
    """Return θ (r,) with one component moved by its step, for each of the columns."""
    shifts = np.zeros((len(columns), len(theta)))
    shifts[range(len(columns)), columns] = steps
    return list(theta + shifts)


def _carries_imu(errors: SensorErrors, model: RobotModel) -> BoolArray:
    """Return which joints (J,) lie between the base and an IMU."""
    links = [model.frame(name).link for name in errors.imu_frames]
    return np.asarray(model.ancestors[:, links].any(axis=1))


def _carried_phi(parameters: ParameterSet, phi: FloatArray, stamp: IntArray) -> FloatArray:
    """Return φ (N or 1, L, 10) of all links with the payloads that they carry."""
    links = np.zeros((1, len(parameters.model.links), 10))
    links[0, parameters.links] = parameters.link_phi(phi)
    for payload in parameters.payloads:
        links = np.broadcast_to(links, (len(stamp), *links.shape[1:])).copy()
        links[:, payload.link] += payload.is_carried(stamp)[:, None] * payload.phi
    return links


def _fill_plates(
    C: FloatArray,
    errors: SensorErrors,
    model: RobotModel,
    readings: SensorSamples,
    theta: FloatArray,
) -> None:
    """Fill the columns of the wrench sensors' errors; y is linear in the wrenches."""
    frames = errors.wrench_frames
    linear = {"wrench_offset", "wrench_gain", "wrench_position", FRAME}
    if linear.isdisjoint(errors.kinds) or not frames:
        return
    corrected = errors.corrected(readings, theta)
    poses = link_poses(model, model.apply_mimics(corrected.position))
    response = contact_jacobian(model, frames, poses).transpose(0, 2, 1)
    response = response.reshape(len(readings), model.dof, len(frames), 6)
    gain = 1 + errors.of_kind("wrench_gain", theta)
    realigned = errors.realigned(readings, theta)
    rescaled = (realigned.wrenches - errors.of_kind("wrench_offset", theta)) / gain
    lever = errors.of_kind("wrench_position", theta)
    # Derivative of the corrected wrench by each component of the uncorrected one.
    correction = np.tile(np.eye(6), (len(frames), 1, 1))
    correction[:, :3, 3:] = np.cross(lever[:, None], np.eye(3)).swapaxes(1, 2)
    raw_response = np.einsum("tnfi,fij->tnfj", response, correction)
    turns = np.zeros((len(frames), 3))
    if FRAME in errors.kinds:
        turns = errors.of_kind(FRAME, theta)[: len(frames)]
        turned = Rotation.from_rotvec(turns).as_matrix()
        pairs = response.reshape(*response.shape[:3], 2, 3)
        raw = np.einsum("tnfki,fij->tnfkj", pairs, turned)
        raw_response = np.einsum("tnfi,fij->tnfj", raw.reshape(response.shape), correction)
        wrenches = corrected.wrenches.reshape(*corrected.wrenches.shape[:2], 1, 2, 3)
        spun = np.cross(left_jacobian(turns).swapaxes(1, 2)[None, :, :, None], wrenches)
        place = errors.places[FRAME]
        C[:, :, place.start : place.start + 3 * len(frames)] = np.einsum(
            "tnfki,tfjki->tnfj", pairs, spun
        ).reshape(len(readings), model.dof, -1)
        response = raw.reshape(response.shape)
    changes = {
        "wrench_offset": -raw_response / gain,
        "wrench_gain": -raw_response * (rescaled / gain)[:, None],
        "wrench_position": np.einsum(
            "tnfi,tfji->tnfj",
            response[..., :3],
            np.cross(np.eye(3), rescaled[:, :, None, 3:]),
        ),
    }
    for kind, change in changes.items():
        if kind in errors.kinds:
            C[:, :, errors.places[kind]] = change.reshape(len(readings), model.dof, -1)


@dataclass(frozen=True)
class CalibratingRows:
    """Builds rows in the robot's parameters and its sensors' errors, a ``RowBuilder``.

    Attributes
    ----------
    parameters : ParameterSet
        The robot's p columns.
    errors : SensorErrors
        The r columns that follow.
    linearization : LinearizationPoint
    drift : SensorDrift or None
        Changes of these errors during the log, whose columns come last.
    """

    parameters: ParameterSet
    errors: SensorErrors
    linearization: LinearizationPoint
    drift: SensorDrift | None = None

    @cached_property
    def placed(self) -> ParameterSet:
        """The parameters of the robot with the joints displaced as at the linearization point."""
        return self.errors.placed(self.parameters, self.linearization.theta)

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        parameters, errors, point = self.placed, self.errors, self.linearization
        for start in range(0, len(readings), CHUNK):
            part = readings[start : start + CHUNK]
            samples = at_base(errors.corrected(part, point.theta), parameters.model)
            columns = interpolated_columns(self.parameters, errors, point, part)
            size = samples_at_once(parameters)
            for first in range(0, len(part), size):
                some = slice(first, first + size)
                yield self._rows(samples[some], columns[some])

    def _rows(self, samples: Samples, C: FloatArray) -> SampledRows:
        """Return the rows of few samples with the columns C (N, n, r) of the sensors' errors."""
        parameters, errors, point = self.placed, self.errors, self.linearization
        rows = equation_of_motion(parameters, samples)
        if errors.gained:
            C = C.copy()
            place = errors.places[DRIVE_GAIN]
            rows_of = 6 * parameters.model.floating + np.array(errors.gained_joints)
            # The effort as the model predicts it: that which was measured contains noise, with
            # which small factors and small masses would look more probable. Not interpolated,
            # because a common scale of factors and masses must leave no residual at all.
            unexplained = (rows.y - rows.K @ point.phi)[:, rows_of]
            predicted = samples.effort[:, errors.gained_joints] - unexplained
            C[:, rows_of, range(place.start, place.stop)] = (
                np.nan_to_num(predicted) / point.theta[place]
            )
        columns = [rows.K, -C]
        if self.drift is not None:
            columns.append(-self.drift.columns(C, samples.stamp))
        rows = Rows(np.concatenate(columns, axis=2), rows.y - C @ point.theta)
        return rows_that_hold(parameters, samples, rows)


def interpolated_columns(
    parameters: ParameterSet,
    errors: SensorErrors,
    linearization: LinearizationPoint,
    readings: SensorSamples,
) -> FloatArray:
    """Return :func:`error_columns` of all samples, from some of them."""
    touching = readings.touching
    if touching is not None:  # other rows begin where a contact begins or ends
        changes = np.flatnonzero(np.any(touching[1:] != touching[:-1], axis=1)) + 1
        if len(changes):
            ends = [0, *changes.tolist(), len(readings)]
            parts = [readings[start:stop] for start, stop in pairwise(ends)]
            return np.concatenate(
                [interpolated_columns(parameters, errors, linearization, one) for one in parts]
            )
    starts = np.flatnonzero(
        np.diff(
            readings.stamp // COLUMN_PERIOD_NS, prepend=readings.stamp[0] // COLUMN_PERIOD_NS - 1
        )
    )
    # Noise of single samples in the columns would count as information.
    means = readings.averaged(starts)
    at_means = error_columns(parameters, errors, linearization, means)
    if len(means) == 1:
        return np.broadcast_to(at_means, (len(readings), *at_means.shape[1:]))
    place = np.interp(readings.stamp, means.stamp, np.arange(len(means)))
    before = np.minimum(place.astype(int), len(means) - 2)
    share = (place - before)[:, None, None]
    columns: FloatArray = at_means[before] * (1 - share) + at_means[before + 1] * share
    return columns
