"""Logs without a simulator: all motion is sums of sines, and the forces are what it takes."""

from dataclasses import fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.dynamics.imu import BaseMotion
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.calibration.extended_problem import calibration_windows
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples

SLOWEST, FASTEST = 0.3, 1.5  # Hz
SHAKING = 15.0, 110.0  # Hz


def waves(rng, time, shape, size):
    """Return sums of three sines (N, *shape) and their first two derivatives."""
    omega, phase = 2 * np.pi * rng.uniform(SLOWEST, FASTEST, (3, *shape)), rng.uniform(0, 6, shape)
    amplitude = size * rng.uniform(0.3, 1, (3, *shape)) / 3
    angle = np.multiply.outer(time, omega) + phase
    value = np.sum(amplitude * np.sin(angle), axis=1)
    rate = np.sum(amplitude * omega * np.cos(angle), axis=1)
    return value, rate, np.sum(-amplitude * omega**2 * np.sin(angle), axis=1)


def shaken(rng, time, shape, size, order):
    """Return sums of eight fast sines (N, *shape) and derivatives, the last of which has a size.

    The value is differentiated ``order`` times.
    """
    omega, phase = 2 * np.pi * rng.uniform(*SHAKING, (8, *shape)), rng.uniform(0, 6, (8, *shape))
    angle = np.multiply.outer(time, omega) + phase
    derivatives = (np.sin(angle), omega * np.cos(angle), -(omega**2) * np.sin(angle))
    return [np.sum(0.5 * size / omega**order * part, axis=1) for part in derivatives[: order + 1]]


def analytic_samples(parameters, stamp, seed, wrench_frames=None, *, shaking=0.0):
    """Return exact motion at stamps (N,), ns, with the forces that the parameters need.

    The first wrench sensor carries what the base needs, the others push as they like. All
    accelerations also vibrate with a root mean square ``shaking``, rad/s² and m/s².
    """
    model, rng = parameters.model, np.random.default_rng(seed)
    time, joints = stamp * 1e-9, len(model.joints)
    if wrench_frames is None:
        wrench_frames = tuple(
            f.name for f in model.frames if "wrench" in f.name or "sole" in f.name
        )
    position, velocity, acceleration = waves(rng, time, (joints,), 0.8)
    omega, alpha, _ = waves(rng, time, (3,), 1.0)
    force = np.array([0, 0, 9.81]) + waves(rng, time, (3,), 2.0)[0]
    if shaking:
        parts = shaken(rng, time, (joints,), shaking, 2)
        position, velocity, acceleration = map(
            sum, zip((position, velocity, acceleration), parts, strict=True)
        )
        rate, slope = shaken(rng, time, (3,), shaking, 1)
        omega, alpha = omega + rate, alpha + slope
        force = force + shaken(rng, time, (3,), shaking, 0)[0]
    if not model.floating:
        omega, alpha, force = 0 * omega, 0 * alpha, np.tile(-model.gravity, (len(time), 1))
    samples = Samples(
        stamp=stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=np.zeros_like(position),
        base_angular_velocity=omega,
        base_angular_acceleration=alpha,
        base_specific_force=force,
        wrenches=waves(rng, time, (len(wrench_frames), 6), 20.0)[0],
        wrench_frames=wrench_frames,
    )
    if model.floating:
        samples.wrenches[:, 0] = 0
        owed = _owed(parameters, samples)[:, :6]
        response = np.empty((len(stamp), 6, 6))
        for component in range(6):
            unit = np.zeros_like(samples.wrenches)
            unit[:, 0, component] = 1.0
            alone = equation_of_motion(parameters, replace(samples, wrenches=unit))
            response[:, :, component] = alone.y[:, :6]
        samples.wrenches[:, 0] = np.linalg.solve(response, owed[:, :, None])[:, :, 0]
    return replace(samples, effort=_owed(parameters, samples)[:, 6 * model.floating :])


def _owed(parameters, samples):
    rows = equation_of_motion(parameters, samples)
    return rows.K @ parameters.values - rows.y


def imu_motion(model, samples, frame_name):
    """Return what an IMU feels, from the base's motion outwards, link by link."""
    links = [(samples.base_angular_velocity, samples.base_angular_acceleration)]
    forces = [samples.base_specific_force]
    for index, joint in enumerate(model.joints):
        (omega, alpha), force = links[joint.parent], forces[joint.parent]
        q = (samples.position[:, index] - joint.reference)[:, None] * joint.axis
        qd, qdd = (x[:, index, None] * joint.axis for x in (samples.velocity, samples.acceleration))
        turns = joint.kind == "revolute"
        rotation = joint.rotation @ Rotation.from_rotvec(turns * q).as_matrix()
        arm = joint.translation + (not turns) * q @ joint.rotation.T
        omega, alpha, force = _carried(omega, alpha, force, rotation, arm)
        links.append((omega + turns * qd, alpha + turns * (qdd + np.cross(omega, qd))))
        forces.append(force + (not turns) * (qdd + 2 * np.cross(omega, qd)))
    frame = model.frame(frame_name)
    rotation = np.broadcast_to(frame.rotation, (len(samples), 3, 3))
    return BaseMotion(
        *_carried(*links[frame.link], forces[frame.link], rotation, frame.translation)
    )


def _carried(omega, alpha, force, rotation, arm):
    arm = np.broadcast_to(arm, omega.shape)
    force = force + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    return tuple(np.einsum("nji,nj->ni", rotation, x) for x in (omega, alpha, force))


def readings_of(model, samples, imu_frames=("imu_link",)):
    """Return the readings of perfect sensors, with exact derivatives."""
    return SensorSamples(
        stamp=samples.stamp,
        position=samples.position,
        velocity=samples.velocity,
        acceleration=samples.acceleration,
        effort=samples.effort,
        **stacked([imu_motion(model, samples, frame) for frame in imu_frames], len(samples)),
        wrenches=samples.wrenches,
        imu_frames=tuple(imu_frames),
        wrench_frames=samples.wrench_frames,
    )


def stacked(motions, count):
    """Return the fields of SensorSamples (N, I, 3) from the motion of each IMU."""
    return {
        field.name: np.reshape(
            [getattr(motion, field.name) for motion in motions], (-1, count, 3)
        ).swapaxes(0, 1)
        for field in fields(BaseMotion)
    }


def segment_of(readings, rate):
    """Return the channels of readings (N,) at a uniform rate, Hz."""
    return Segment(
        stamp=readings.stamp,
        rate=rate,
        position=readings.position,
        effort=readings.effort,
        angular_velocity=readings.angular_velocity,
        linear_acceleration=readings.specific_force,
        wrenches=readings.wrenches,
        imu_frames=readings.imu_frames,
        wrench_frames=readings.wrench_frames,
    )


def analytic_segment(
    parameters,
    seconds,
    seed,
    *,
    rate=1000.0,
    start=0.0,
    imu_frames=("imu_link",),
    shaking=0.0,
):
    """Return what perfect sensors say of a motion, uniformly sampled from ``start``, s."""
    period = round(1e9 / rate)
    stamp = round(start * 1e9) + period * np.arange(round(seconds * rate), dtype=np.int64)
    samples = analytic_samples(parameters, stamp, seed, shaking=shaking)
    imu_frames = imu_frames if parameters.model.floating else ()
    return segment_of(readings_of(parameters.model, samples, imu_frames), 1e9 / period)


def noisy(segment, rng, *, position=0.0, rate=0.0, acceleration=0.0, effort=0.0, wrench=0.0):
    """Return the segment with white noise of these standard deviations, moments a tenth."""

    def more(values, deviation):
        return values + deviation * rng.standard_normal(values.shape)

    return replace(
        segment,
        position=more(segment.position, position),
        effort=more(segment.effort, effort),
        angular_velocity=more(segment.angular_velocity, rate),
        linear_acceleration=more(segment.linear_acceleration, acceleration),
        wrenches=more(segment.wrenches, wrench * np.repeat([0.1, 1.0], 3)),
    )


def spoilt(segment, errors, theta):
    """Return what sensors with the errors θ say instead, from their definitions."""
    gain = np.zeros(len(errors.joints))
    gain[errors.driven] = errors.of_kind("torque_gain", theta)[:, 0]
    wrenches = segment.wrenches.copy()
    wrenches[..., :3] -= np.cross(errors.of_kind("wrench_position", theta), wrenches[..., 3:])
    wrenches = wrenches * (1 + errors.of_kind("wrench_gain", theta))
    wrenches += errors.of_kind("wrench_offset", theta)
    turns = Rotation.from_rotvec(errors.of_kind("imu_mounting", theta)).as_matrix()
    bias = errors.of_kind("imu_bias", theta)
    return replace(
        segment,
        position=segment.position + errors.of_kind("encoder_offset", theta)[:, 0],
        effort=segment.effort * (1 + gain),
        angular_velocity=np.einsum("iab,nia->nib", turns, segment.angular_velocity) + bias[:, :3],
        linear_acceleration=np.einsum("iab,nia->nib", turns, segment.linear_acceleration)
        + bias[:, 3:],
        wrenches=wrenches,
    )


def dataset_of(parameters, segments):
    """Return segments as a log without the rows of a robot with exact sensors."""
    segments = tuple(segments)
    layout, windows = RowLayout.of(parameters), calibration_windows(segments[0].rate)
    observations = tuple(Observations.empty(layout, window) for window in windows)
    return Dataset("log", segments, None, observations)
