"""Rows of the robot's parameters and of its sensors' errors together.

Each unknown θ undoes its error in the readings. The equation of motion is linearised in them
about a pilot (φ₀, θ₀), by finite differences where an error moves the kinematics: with
C = ∂(y - K φ₀)/∂θ at θ₀ the rows are [K(θ₀), -C] [φ; θ] = y(θ₀) - C θ₀, so that θ is always the
whole error and rows about different pilots can be added. Repeated about the result, it is a
Gauss-Newton iteration.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.readings import Readings, at_base
from symbid_ros.signals.sensor_errors import SensorErrors
from symbid_ros.signals.weak_form import RowBuilder, SampledRows, sticking_left_out, valid_rows

# The columns change as slowly as the robot moves: they are worked out this often, and
# interpolated.
COLUMN_PERIOD_NS = 20_000_000
CHUNK = 4096
STEP = 1e-4  # of a finite difference, rad, rad/s or m/s²


@dataclass(frozen=True)
class Pilot:
    """Where the rows are linearised: φ₀ (p,) and θ₀ (r,)."""

    phi: FloatArray
    theta: FloatArray


def error_columns(
    parameters: ParameterSet, errors: SensorErrors, pilot: Pilot, readings: Readings
) -> FloatArray:
    """Return C = ∂(y - K φ)/∂θ (N, n, r) at the pilot."""
    theta = pilot.theta
    model = parameters.model

    def residual(at: FloatArray) -> FloatArray:
        rows = equation_of_motion(parameters, at_base(errors.corrected(readings, at), model))
        difference: FloatArray = rows.y - rows.K @ pilot.phi
        return difference

    C = np.zeros((len(readings), model.dof, len(errors)))
    here = residual(theta)
    for kind, place in errors.places.items():
        if kind in ("imu_mounting", "imu_bias", "encoder_offset"):
            for column in range(place.start, place.stop):
                moved = theta.copy()
                moved[column] += STEP
                C[:, :, column] = (residual(moved) - here) / STEP
        elif kind == "torque_gain":
            rows = 6 * model.floating + np.flatnonzero(errors.driven)
            gain = errors.of_kind(kind, theta)[:, 0]
            C[:, rows, range(place.start, place.stop)] = (
                -np.nan_to_num(readings.effort[:, errors.driven]) / (1 + gain) ** 2
            )
    _fill_plates(C, errors, model, readings, theta)
    return C


def _fill_plates(
    C: FloatArray, errors: SensorErrors, model: RobotModel, readings: Readings, theta: FloatArray
) -> None:
    """Write the columns of the wrench sensors' errors: y is linear in the wrenches."""
    frames = errors.wrench_frames
    if not any(kind.startswith("plate") for kind in errors.kinds) or not frames:
        return
    corrected = errors.corrected(readings, theta)
    poses = link_poses(model, model.followed(corrected.position))
    felt = contact_jacobian(model, frames, poses).transpose(0, 2, 1)
    felt = felt.reshape(len(readings), model.dof, len(frames), 6)
    gain = 1 + errors.of_kind("plate_gain", theta)
    unmoved = (readings.wrenches - errors.of_kind("plate_offset", theta)) / gain
    lever = errors.of_kind("plate_pose", theta)
    # How the corrected wrench answers to each component of the uncorrected one.
    answer = np.tile(np.eye(6), (len(frames), 1, 1))
    answer[:, :3, 3:] = np.cross(lever[:, None], np.eye(3)).swapaxes(1, 2)
    felt_raw = np.einsum("tnfi,fij->tnfj", felt, answer)
    changes = {
        "plate_offset": -felt_raw / gain,
        "plate_gain": -felt_raw * (unmoved / gain)[:, None],
        "plate_pose": np.einsum(
            "tnfi,tfji->tnfj",
            felt[..., :3],
            np.cross(np.eye(3), unmoved[:, :, None, 3:]),
        ),
    }
    for kind, change in changes.items():
        if kind in errors.kinds:
            C[:, :, errors.places[kind]] = change.reshape(len(readings), model.dof, -1)


def calibrating_rows(parameters: ParameterSet, errors: SensorErrors, pilot: Pilot) -> RowBuilder:
    """Return what builds the rows of a robot's parameters and its sensors' errors."""

    def build(readings: Readings) -> Iterator[SampledRows]:
        for start in range(0, len(readings), CHUNK):
            part = readings[start : start + CHUNK]
            samples = at_base(errors.corrected(part, pilot.theta), parameters.model)
            rows = equation_of_motion(parameters, samples)
            C = _interpolated_columns(parameters, errors, pilot, part)
            yield valid_rows(
                part.stamp,
                Rows(np.concatenate([rows.K, -C], axis=2), rows.y - C @ pilot.theta),
                sticking_left_out(parameters, samples.velocity),
            )

    return build


def _interpolated_columns(
    parameters: ParameterSet, errors: SensorErrors, pilot: Pilot, readings: Readings
) -> FloatArray:
    starts = np.flatnonzero(
        np.diff(
            readings.stamp // COLUMN_PERIOD_NS, prepend=readings.stamp[0] // COLUMN_PERIOD_NS - 1
        )
    )
    # Single readings would bring noise into the columns, where it looks like information.
    means = readings.averaged(starts)
    at_means = error_columns(parameters, errors, pilot, means)
    if len(means) == 1:
        return np.broadcast_to(at_means, (len(readings), *at_means.shape[1:]))
    place = np.interp(readings.stamp, means.stamp, np.arange(len(means)))
    before = np.minimum(place.astype(int), len(means) - 2)
    share = (place - before)[:, None, None]
    columns: FloatArray = at_means[before] * (1 - share) + at_means[before + 1] * share
    return columns
